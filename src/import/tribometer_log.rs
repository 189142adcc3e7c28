//! Reads a tribometer log: delimited text with named columns, with units in their names or in the next line.
//!
//! Pure: text in, samples out. Formats differ between programs, so the separator (`;`, tab, `,`), the decimal sign,
//! lines before the header, a byte order mark and Latin-1 are detected. An ambiguity is an error; nothing is guessed.

mod field;
mod header;
mod rows;
mod times;
mod values;

use std::borrow::Cow;

pub use field::Field;
use header::{find_header, is_iso, is_unit_row, resolve_unit, with_units};
use rows::{Rows, check_lines};
use values::{Clock, decimal_sign, sample, with_constants};

/// Why a log is invalid. Lines are counted from 1.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LogError {
    #[error("no line names the columns needed: {missing} not found; line {line} comes closest: {header:?}{hint}")]
    NoHeader { line: usize, header: String, missing: String, hint: String },
    #[error("line {line}: no column is called {header:?}, which {field} is to be read from")]
    NoSuchColumn { line: usize, field: Field, header: String },
    #[error("line {line}: both {first:?} and {second:?} may be {field}: choose one with --column {field}=NAME")]
    TwoColumns { line: usize, field: Field, first: String, second: String },
    #[error("line {line}, column {column:?}: unit {unit:?} of {field} is not one of {known}")]
    Unit { line: usize, column: String, field: Field, unit: String, known: String },
    #[error("line {line}, column {column:?}: a sliding speed in {unit} becomes a disc speed with --radius-m")]
    NoRadius { line: usize, column: String, unit: &'static str },
    #[error(
        "both decimal commas and decimal points: {comma:?} in line {comma_line}, {point:?} in line {point_line}: \
         choose one with --decimal"
    )]
    Decimal { comma: String, comma_line: usize, point: String, point_line: usize },
    #[error("constant {field} = {value} is outside of {min} to {max}")]
    Constant { field: Field, value: f64, min: f64, max: f64 },
    #[error(
        "{field} cannot be constant; expected normal_load_n, disc_speed_rad_s, friction_coefficient or temperature_c"
    )]
    NoConstant { field: Field },
    #[error("line {line}, column {column:?}: {value:?} is not {expected}")]
    Value { line: usize, column: String, value: String, expected: &'static str },
    #[error("line {line}, column {column:?}: {value} is outside of {min} to {max}")]
    Limit { line: usize, column: String, value: f64, min: f64, max: f64 },
    #[error(
        "line {line}: time {value:?} is not later than that of line {before}; if times begin again with each step of a \
         test, --times-restart joins the steps"
    )]
    NotLater { line: usize, before: usize, value: String },
    #[error("line {line}: {cells} cells, where column {column:?} is number {number}")]
    Short { line: usize, cells: usize, column: String, number: usize },
    #[error("line {line}: {reason}")]
    Text { line: usize, reason: String },
    #[error("no samples below line {line}")]
    NoSamples { line: usize },
}

/// Options for reading a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogOptions {
    /// Columns chosen by their name in the log instead of by the usual names; after a `-`, with the opposite sign. The
    /// unit is the one in the column name, else the one in the field's name.
    pub columns: Vec<(Field, String)>,
    /// Quantities of the same value in every line instead of in a column, in the units of the field names.
    pub constants: Vec<(Field, f64)>,
    /// Distance from the disc's axis at which sliding speeds were measured, m.
    pub radius_m: Option<f64>,
    /// Times that begin again continue one interval after the line before.
    pub times_restart: bool,
    /// `,` or `.`; `None` detects it.
    pub decimal: Option<char>,
    /// Origin of relative times, ns since the epoch. Times of a billion seconds or more count from the epoch itself.
    pub start_ns: i64,
    /// Accepted ranges, ends included, in the units of the field names.
    pub normal_load_n: [f64; 2],
    pub disc_speed_rad_s: [f64; 2],
    pub friction_coefficient: [f64; 2],
    pub temperature_c: [f64; 2],
    /// Skip invalid lines instead of refusing the log.
    pub skip_bad_lines: bool,
}

impl Default for LogOptions {
    /// The default origin of relative times is 2000-01-01, so that an import always gives the same recording.
    fn default() -> Self {
        Self {
            columns: Vec::new(),
            constants: Vec::new(),
            radius_m: None,
            times_restart: false,
            decimal: None,
            start_ns: 946_684_800_000_000_000,
            normal_load_n: [0.0, 1e6],
            disc_speed_rad_s: [-1e4, 1e4],
            friction_coefficient: [0.0, 2.0],
            temperature_c: [-273.15, 3000.0],
            skip_bad_lines: false,
        }
    }
}

/// The operating point in one line of the log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// ns since the epoch.
    pub stamp_ns: i64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
    /// `None` if the log has no temperature there.
    pub temperature_c: Option<f64>,
}

/// A column that is used.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    pub field: Field,
    /// Its name in the log.
    pub header: String,
    /// Empty if it has none (dates, friction coefficients).
    pub unit: String,
    /// Whether its values have the opposite sign.
    pub reversed: bool,
    index: usize,
    factor: f64,
}

/// The content of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct TribometerLog {
    pub samples: Vec<Sample>,
    pub columns: Vec<Column>,
    /// Quantities of the same value in every line.
    pub constants: Vec<(Field, f64)>,
    /// Names of the columns that are not used, without empty names.
    pub left_out: Vec<String>,
    pub separator: char,
    pub decimal: char,
    /// Number of lines skipped, and the error of the first.
    pub skipped: usize,
    pub first_skipped: Option<LogError>,
}

/// Decodes the text of a log: UTF-8 or UTF-16 according to its byte order mark, else UTF-8, else Latin-1.
pub fn decode_text(bytes: &[u8]) -> Cow<'_, str> {
    let utf16 = |bytes: &[u8], unit: fn([u8; 2]) -> u16| {
        let units = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
        char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect::<String>().into()
    };
    match bytes {
        [0xff, 0xfe, rest @ ..] => utf16(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => utf16(rest, u16::from_be_bytes),
        _ => {
            let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
            match std::str::from_utf8(bytes) {
                Ok(text) => text.into(),
                Err(_) => bytes.iter().map(|&byte| char::from(byte)).collect::<String>().into(),
            }
        }
    }
}

/// Reads a log.
///
/// # Errors
///
/// See [`LogError`]; with [`LogOptions::skip_bad_lines`] only errors that concern the whole log.
pub fn parse(text: &str, options: &LogOptions) -> Result<TribometerLog, LogError> {
    check_lines(text)?;
    with_constants(options)?;
    let header = find_header(text, options)?;
    // The rows are parsed again for each question, one at a time: keeping all would take many times the memory of the
    // text.
    let rows = |skipped: usize| Rows::below(text, &header).skip(skipped);
    let first = rows(0).next().transpose()?;
    let (mut columns, unit_rows) = match first {
        Some(first) if is_unit_row(&first, &header.columns) => (with_units(&first, header.columns.clone())?, 1),
        _ => (header.columns.clone(), 0),
    };
    let iso = rows(unit_rows).next().transpose()?.is_some_and(|first| is_iso(&first, &columns));
    let is_chosen = |field| options.columns.iter().any(|(chosen, _)| *chosen == field);
    columns.retain(|column| {
        let Column { field, ref unit, .. } = *column;
        !field.is_optional() || is_chosen(field) || field.unit(unit).is_some()
    });
    for column in &mut columns {
        resolve_unit(column, header.line, iso, options)?;
    }
    let decimal = match options.decimal {
        Some(sign) => sign,
        None => decimal_sign(rows(unit_rows), &columns, iso)?,
    };

    let read = |index: &usize| columns.iter().any(|column| column.index == *index);
    let left_out = header.cells.iter().enumerate().filter(|(index, cell)| !read(index) && !cell.is_empty());
    let mut log = TribometerLog {
        samples: Vec::new(),
        left_out: left_out.map(|(_, cell)| cell.clone()).collect(),
        columns,
        constants: options.constants.clone(),
        separator: char::from(header.separator),
        decimal,
        skipped: 0,
        first_skipped: None,
    };
    let mut clock = Clock::default();
    let mut absolute = None;
    for row in rows(unit_rows) {
        let row = row?;
        let sample = sample(&row, &log.columns, decimal, iso, &mut absolute, options)
            .and_then(|sample| clock.place(sample, &row, &log.columns, options.times_restart));
        match sample {
            Ok(sample) => log.samples.push(sample),
            Err(error) if options.skip_bad_lines => {
                log.skipped += 1;
                log.first_skipped.get_or_insert(error);
            }
            Err(error) => return Err(error),
        }
    }
    if log.samples.is_empty() {
        return Err(log.first_skipped.unwrap_or(LogError::NoSamples { line: header.line }));
    }
    Ok(log)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use proptest::prelude::*;

    const T0: i64 = 946_684_800_000_000_000;

    fn read(text: &str) -> Result<TribometerLog, LogError> {
        parse(text, &LogOptions::default())
    }

    fn samples(text: &str) -> Vec<(i64, f64, f64, f64)> {
        let log = read(text).unwrap_or_else(|error| panic!("{error}"));
        let parts = |s: &Sample| (s.stamp_ns - T0, s.normal_load_n, s.disc_speed_rad_s, s.friction_coefficient);
        log.samples.iter().map(parts).collect()
    }

    #[test]
    fn our_own_names() {
        let text = "time_s,normal_load_n,disc_speed_rad_s,friction_coefficient\n0,500,13,0.35\n0.002,501.5,13,0.36\n";
        assert_eq!(samples(text), [(0, 500.0, 13.0, 0.35), (2_000_000, 501.5, 13.0, 0.36)]);
    }

    #[test]
    fn a_german_log_in_latin_1_with_lines_before() {
        let bytes =
            b"Pr\xfcfstand 7\r\nDatum;31.01.2024\r\n\r\nZeit [ms];Normalkraft [kN];Drehzahl (1/min);Reibwert [-]\r\n\
                      0,5;0,5;120;0,35\r\n1,0;1.000,25;-60;0,4\r\n";
        let mut options = LogOptions { normal_load_n: [0.0, 1e7], ..LogOptions::default() };
        let log = parse(&decode_text(bytes), &options).unwrap();
        assert_eq!((log.separator, log.decimal), (';', ','));
        assert_eq!(log.samples[0].stamp_ns, T0 + 500_000);
        assert_eq!(log.samples[0].normal_load_n, 500.0);
        assert!((log.samples[0].disc_speed_rad_s - 4.0 * std::f64::consts::PI).abs() < 1e-12);
        assert_eq!(log.samples[1].normal_load_n, 1_000_250.0);
        options.normal_load_n = [0.0, 1e6];
        let error = parse(&decode_text(bytes), &options).unwrap_err();
        let column = "Normalkraft [kN]".to_owned();
        assert_eq!(error, LogError::Limit { line: 6, column, value: 1_000_250.0, min: 0.0, max: 1e6 });
    }

    #[test]
    fn units_in_the_line_below_tabs_utf_16_and_a_friction_force() {
        let text = "Time\tLoad\tSpeed\tFriction force\ns\tkN\trpm\tN\n0\t0.5\t60\t175\n1\t0\t60\t3\n";
        let mut bytes = vec![0xff, 0xfe];
        bytes.extend(text.encode_utf16().flat_map(u16::to_le_bytes));
        let got = samples(&decode_text(&bytes));
        assert_eq!(got[0].3, 0.35);
        assert!((got[0].2 - TAU).abs() < 1e-12);
        assert_eq!(got[1].3, 0.0, "no load, no contact");
    }

    #[test]
    fn absolute_times_keep_their_nanoseconds() {
        let head = "timestamp,load_n,speed_rad_s,mu\n";
        let first = |line: &str| read(&format!("{head}{line},500,13,0.3\n")).unwrap().samples[0].stamp_ns;
        assert_eq!(first("2024-01-31T12:00:00.123456789Z"), 1_706_702_400_123_456_789);
        assert_eq!(first("2024-01-31T13:00:00.5+01:00"), 1_706_702_400_500_000_000);
        assert_eq!(first("2024-01-31 12:00:00.25"), 1_706_702_400_250_000_000);
        let unix = read("time_s,load_n,speed_rad_s,mu\n1706702400.123456789,500,13,0.3\n").unwrap();
        assert_eq!(unix.samples[0].stamp_ns, 1_706_702_400_123_456_789);
    }

    /// A temperature is taken where one column certainly holds it, and may be measured more slowly than the rest.
    #[test]
    fn a_temperature_is_read_where_there_is_one() {
        let temperatures = |header: &str, options: &LogOptions| -> Vec<Option<f64>> {
            let text = format!("time_s;load_n;speed_rad_s;mu;{header}\n0;500;13;0.3;85.5;x\n1;500;13;0.3;;y\n");
            let log = parse(&text, options).unwrap_or_else(|error| panic!("{header}: {error}"));
            log.samples.iter().map(|sample| sample.temperature_c).collect()
        };
        let usual = LogOptions::default();
        for header in ["temperature_c;note", "Contact temperature [°C];note", "Temperatur (C);note"] {
            assert_eq!(temperatures(header, &usual), [Some(85.5), None], "{header}");
        }
        for header in ["temperature;note", "temperature [F];note", "pad_c;note", "temperature [°C];Temperature (C)"] {
            assert_eq!(temperatures(header, &usual), [None, None], "{header}");
        }
        let columns = vec![(Field::TemperatureC, "pad_c".to_owned())];
        let chosen = LogOptions { columns, ..LogOptions::default() };
        assert_eq!(temperatures("pad_c;note", &chosen), [Some(85.5), None]);
        let constants = vec![(Field::TemperatureC, 40.0)];
        let constant = LogOptions { constants, ..LogOptions::default() };
        assert_eq!(temperatures("pad_c;note", &constant), [Some(40.0); 2]);
        let hot = LogOptions { temperature_c: [0.0, 80.0], ..LogOptions::default() };
        let error = parse("time_s,load_n,speed_rad_s,mu,temperature_c\n0,500,13,0.3,85.5\n", &hot).unwrap_err();
        assert_eq!(error.to_string(), "line 2, column \"temperature_c\": 85.5 is outside of 0 to 80");
    }

    #[test]
    fn columns_can_be_named() {
        let text = "t,F_norm,n,cof\n0,500,13,0.3\n";
        let columns = vec![
            (Field::Time, "t".to_owned()),
            (Field::NormalLoadN, "F_norm".to_owned()),
            (Field::DiscSpeedRadS, "n".to_owned()),
        ];
        let log = parse(text, &LogOptions { columns: columns.clone(), ..LogOptions::default() }).unwrap();
        assert_eq!(log.samples[0].normal_load_n, 500.0);
        let columns = vec![(Field::NormalLoadN, "F".to_owned())];
        let error =
            parse("t [s],F_norm,speed_rpm,cof\n", &LogOptions { columns, ..LogOptions::default() }).unwrap_err();
        assert!(matches!(error, LogError::NoSuchColumn { field: Field::NormalLoadN, .. }), "{error}");
    }

    #[test]
    fn what_is_wrong_is_named() {
        let head = "time_s,load_n,speed_rad_s,mu\n";
        let error = |lines: &str| read(&format!("{head}{lines}")).unwrap_err().to_string();
        assert_eq!(error("0,500,13,NaN\n"), "line 2, column \"mu\": \"NaN\" is not a finite number");
        assert_eq!(error("0,500,13,0.3\n0,,13,0.3\n"), "line 3, column \"load_n\": \"\" is not a finite number");
        let again = error("0,500,13,0.3\n\n0,500,13,0.3\n");
        assert!(again.starts_with("line 4: time \"0\" is not later than that of line 2; "), "{again}");
        assert_eq!(error("0,500\n"), "line 2: 2 cells, where column \"speed_rad_s\" is number 3");
        assert_eq!(error("0,500,13,2.5\n"), "line 2, column \"mu\": 2.5 is outside of 0 to 2");
        assert_eq!(error(""), "no samples below line 1");
        assert!(matches!(read("time_s,load,speed_rpm,mu\n0,1,1,0\n"), Err(LogError::Unit { .. })));
        assert!(matches!(read("time_s,load_n,load_kn,speed_rpm,mu\n"), Err(LogError::TwoColumns { .. })));
        assert!(matches!(read("time_s,speed_rpm,mu\n"), Err(LogError::NoHeader { line: 1, .. })));
        let mixed = "time_s;load_n;speed_rad_s;mu\n0;1.234;13;0,3\n";
        assert!(matches!(read(mixed), Err(LogError::Decimal { .. })));
        let log = parse(mixed, &LogOptions { decimal: Some(','), ..LogOptions::default() }).unwrap();
        assert_eq!(log.samples[0].normal_load_n, 1234.0);
    }

    /// Headers and units as in public files, with values of our own.
    #[test]
    fn logs_of_common_tribometers_are_read() {
        let named = |field, name: &str| (field, name.to_owned());
        let read = |text: &str, options: &LogOptions| {
            let log = parse(text, options).unwrap_or_else(|error| panic!("{error}"));
            let times: Vec<i64> = log.samples.iter().map(|sample| (sample.stamp_ns - T0) / 1_000_000).collect();
            (times, log.samples[0], log.skipped)
        };
        let close = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 1e-12, "{found}, {expected}");
        // CETR UMT, two steps (github.com/okilitive/CETR-tribometer): forces in grams, negative where they press, no speed.
        let head = "Fx,Fz,Z,T,Ff,COF\r\ng,g,mm,sec,g,\r\n";
        let step = "7.5,-200,-0.69,0.0000,7.5,0.0375\r\n8.0,-200,-0.69,0.0200,8.0,0.04\r\n";
        let cetr =
            format!("Created by CETR UMT ver.1\r\nStep No. 1\r\n\r\n{head}\r\n{step}\r\nStep No. 2\r\n{head}{step}");
        let options = LogOptions {
            columns: vec![named(Field::NormalLoadN, "-Fz")],
            constants: vec![(Field::DiscSpeedRadS, 8.0)],
            times_restart: true,
            skip_bad_lines: true,
            ..LogOptions::default()
        };
        let (times, first, skipped) = read(&cetr, &options);
        assert_eq!((times, skipped), (vec![0, 20, 40, 60], 3));
        close(first.normal_load_n, 0.2 * 9.80665);
        assert_eq!((first.disc_speed_rad_s, first.friction_coefficient), (8.0, 0.0375));
        // Rtec MFT, as public readers of its files have it: a line of metadata within which a CR stands alone,
        // times without unit that begin again, a comma at the end, and the total time below.
        let rtec = "Name,Date\rrun,1/2/2024\r\nStep, Timestamp, RecipeStep, DAQ.Fz (N),DAQ.Fx (N),DAQ.COF (),Rotary.Velocity (rpm),\r\n\
                    1,0.00,1,20.0,8.0,0.4,60,\n1,0.01,1,20.0,8.2,0.41,60,\n2,0.00,2,20.0,8.2,0.41,60,\nTotalTime\n00:00:00.02\n";
        let columns = vec![named(Field::Time, "Timestamp")];
        let (times, first, skipped) = read(rtec, &LogOptions { columns, constants: vec![], ..options.clone() });
        assert_eq!((times, skipped), (vec![0, 10, 20], 2));
        close(first.disc_speed_rad_s, TAU);
        assert_eq!((first.normal_load_n, first.friction_coefficient), (20.0, 0.4));
        // Anton Paar TRB3: tabs, the speed of sliding, the load of the weights.
        let trb3 = "TRB3\nTime [s]\tDistance [m]\tLaps\tMax Linear Speed [m/s]\tNominal Load [N]\tµ\tAngle [°]\tFriction Force [N]\n\
                    0.5\t0.05\t1\t0.1\t10\t0.62\t12\t6.2\n";
        let error = parse(trb3, &LogOptions::default()).unwrap_err();
        assert!(error.to_string().ends_with("a sliding speed in m/s becomes a disc speed with --radius-m"), "{error}");
        let (times, first, _) = read(trb3, &LogOptions { radius_m: Some(0.008), ..LogOptions::default() });
        close(first.disc_speed_rad_s, 12.5);
        assert_eq!((times, first.normal_load_n, first.friction_coefficient), (vec![500], 10.0, 0.62));
        // T-11: semicolons, no load, friction as a force.
        let t11 = "Time [s];Friction force [N];Displacement [um];Rotational speed [rpm];Number of revolutions\n1;9,81;3;120;2\n";
        let error = parse(t11, &LogOptions::default()).unwrap_err().to_string();
        assert!(
            error.ends_with("--column 'normal_load_n=Friction force [N]'") || error.contains("--constant"),
            "{error}"
        );
        let constants = vec![(Field::NormalLoadN, 19.62)];
        let (_, first, _) = read(t11, &LogOptions { constants, ..LogOptions::default() });
        close(first.friction_coefficient, 0.5);
        let constants = vec![(Field::NormalLoadN, -1.0)];
        let error = parse(t11, &LogOptions { constants, ..LogOptions::default() }).unwrap_err();
        assert_eq!(error.to_string(), "constant normal_load_n = -1 is outside of 0 to 1000000");
    }

    #[test]
    fn units_that_differ_in_capitals_only_are_told_apart() {
        assert_eq!(Field::NormalLoadN.unit("mN"), Some(("mN", 1e-3)));
        assert_eq!(Field::NormalLoadN.unit("MN"), None);
        assert_eq!(Field::NormalLoadN.unit("KN"), Some(("kN", 1e3)));
    }

    #[test]
    fn bad_lines_can_be_left_out() {
        let options = LogOptions { skip_bad_lines: true, ..LogOptions::default() };
        let log = parse("time_s,load_n,speed_rad_s,mu\n0,500,13,0.3\n1,x,13,0.3\n2,500,13,0.3\n", &options).unwrap();
        assert_eq!((log.samples.len(), log.skipped), (2, 1));
        assert!(matches!(log.first_skipped, Some(LogError::Value { line: 3, .. })));
    }

    proptest! {
        #[test]
        fn any_bytes_are_an_answer_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let _ = read(&decode_text(&bytes));
        }

        #[test]
        fn any_lines_below_a_header_are_an_answer_or_an_error(text in "[-0-9eE.,;:TZ +\t\"\n\u{e4}]{0,200}") {
            let _ = read(&format!("time_s;load_n;speed_rpm;mu\n{text}"));
            let _ = read(&format!("time_s,load_n,speed_rpm,mu\n{text}"));
        }
    }
}
