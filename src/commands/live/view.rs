//! Draws the live table: the assessment first, then the modes in descending order of growth rate.

use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Modifier, Style, Stylize};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Row, Table};

use super::Frame;
use crate::msgs::Mode;
use crate::node::Snapshot;
use crate::node::status::{Assessment, Status};
use crate::text::number::{above_error, significant};

/// Number of rows reserved for the table of modes, including border and header, however long the text above it is.
const LEAST_TABLE: u16 = 5;

/// The content of one update.
pub struct View<'a> {
    pub around: &'a Frame,
    pub snapshot: &'a Snapshot,
    /// The latest line for standard error.
    pub note: Option<&'a str>,
    /// Index of the first scrolling mode shown.
    pub first_row: usize,
}

impl View<'_> {
    /// Draws the view; returns the first row that could be shown.
    pub fn draw(&self, frame: &mut ratatui::Frame<'_>) -> usize {
        let area = frame.area();
        let inner = usize::from(area.width.saturating_sub(2));
        let said = self.snapshot.assessment();
        let head = self.head(&said, inner);
        let foot = usize::from(self.note.is_some()) as u16 + 1;
        let head_height = (head.len() as u16 + 2).min(area.height.saturating_sub(LEAST_TABLE + foot));
        let areas = [Constraint::Length(head_height), Constraint::Min(0), Constraint::Length(foot)];
        let [head_area, table_area, foot_area] = Layout::vertical(areas).areas(area);
        let title = fitting(&self.around.title, " - ", inner.saturating_sub(2));
        let (title, rest) = self.around.title.split_at(title);
        let block = Block::bordered().title(format!(" {} ", title.join(" - ")));
        frame.render_widget(Paragraph::new(head).block(block), head_area);
        let (table, first_row) = self.table(said.status, table_area.width, table_area.height);
        frame.render_widget(table, table_area);
        let mut foot = vec!["q quits".to_owned()];
        foot.extend(rest.iter().rev().cloned());
        foot.extend((self.around.foot)(self.snapshot));
        foot.truncate(fitting(&foot, "  ", inner));
        let mut lines: Vec<Line<'_>> = self.note.map(|note| Line::from(format!(" {note}"))).into_iter().collect();
        lines.push(Line::from(format!(" {}", foot.join("  "))).dim());
        frame.render_widget(Paragraph::new(lines), foot_area);
        first_row
    }

    /// The assessment in lines of at most `width` characters; numbers are not split.
    fn head(&self, said: &Assessment, width: usize) -> Vec<Line<'static>> {
        let badge = format!(" {} ", said.status.name());
        let style = Style::new().fg(colour(said.status)).add_modifier(Modifier::BOLD | Modifier::REVERSED);
        let mut message = wrapped(&said.message, badge.len() + 1, width).into_iter();
        let first = message.next().unwrap_or_default();
        let mut lines = vec![Line::from(vec![Span::styled(badge, style), Span::raw(format!(" {first}"))])];
        lines.extend(message.map(Line::from));
        let values =
            |values: &[String]| packed(values, "   ", 0, width).into_iter().map(Line::from).collect::<Vec<_>>();
        if let Some(inputs) = self.around.inputs.as_ref().filter(|_| said.status == Status::Waiting) {
            lines.extend(wrapped(&inputs.sentence(), 0, width).into_iter().map(Line::from));
        }
        if let Some(received) = self.snapshot.received.filter(|_| said.status == Status::NoData) {
            lines.push(Line::from(format!("last input {:.1} s ago", received.elapsed().as_secs_f64())));
        }
        if let Some(input) =
            self.snapshot.input.as_ref().filter(|_| said.status.is_known() || said.status == Status::Fault)
        {
            lines.extend(values(&[
                format!("mu {:.4}", input.friction_coefficient),
                format!("load {:.2} N", input.normal_load_n),
                format!("speed {:.3} rad/s", input.disc_speed_rad_s),
            ]));
            if let Some(seen) = &self.snapshot.temperature {
                let stale = if seen.is_stale() { ", stale" } else { "" };
                lines.extend(values(&[format!("temperature {:.1} C{stale}", seen.celsius)]));
            }
        }
        let Some(prediction) = self.snapshot.prediction.as_ref().filter(|_| said.status.is_known()) else {
            return lines;
        };
        let error = prediction.friction_margin_error;
        let bound = if error.is_finite() { format!(" +- {error:.0e}") } else { String::new() };
        lines.extend(values(&[
            format!("margin {}{bound}", significant(prediction.friction_margin, 4)),
            format!("unstable modes {}", prediction.unstable_modes),
        ]));
        if let Some(next) = said.next.as_ref().filter(|next| !said.message.contains(&next.place())) {
            let what = if next.inside { "window" } else { "next" };
            let text = format!("{what}: {} {}", next.modes(), next.place());
            lines.extend(wrapped(&text, 0, width).into_iter().map(Line::from));
        }
        lines.extend(wrapped(&prediction.reason, 0, width).into_iter().map(|line| Line::from(line).dim()));
        lines
    }

    /// The table of modes, in which unstable modes are always visible, and the first row that could be shown.
    fn table(&self, status: Status, width: u16, height: u16) -> (Table<'static>, usize) {
        let modes =
            self.snapshot.prediction.as_ref().filter(|_| status.is_known()).map_or(&[][..], |found| &found.modes);
        let grows = |mode: &Mode| mode.damping_ratio < -self.around.instability_threshold;
        let modes = by_growth(modes);
        let growing = modes.iter().take_while(|mode| grows(mode)).count();
        let room = usize::from(height.saturating_sub(3));
        // If there is not enough space for all unstable modes, they scroll too.
        let fixed = if growing < room { growing } else { 0 };
        let (fixed, scrolled) = modes.split_at(fixed);
        let room = room - fixed.len();
        let first = self.first_row.min(scrolled.len().saturating_sub(room));
        let shown = scrolled.iter().skip(first).take(room);
        let columns = columns(width.saturating_sub(2));
        let rows = fixed.iter().chain(shown).map(|mode| {
            let grows = grows(mode);
            let row = Row::new(columns.iter().map(|column| {
                let width = usize::from(column.width);
                format!("{:>width$}", (column.text)(mode, grows))
            }));
            if grows { row.style(Style::new().fg(Color::Red).add_modifier(Modifier::BOLD)) } else { row }
        });
        let title = match modes.len() {
            0 => " no modes ".to_owned(),
            all if all > fixed.len() + room => {
                let last = (first + room).min(scrolled.len());
                format!(" modes {} to {} of {all}, up and down ", fixed.len() + first + 1, fixed.len() + last)
            }
            all => format!(" {all} modes "),
        };
        let widths = columns.iter().map(|column| Constraint::Length(column.width));
        let header = Row::new(columns.iter().map(|column| {
            let width = usize::from(column.width);
            format!("{:>width$}", column.title)
        }));
        (Table::new(rows, widths).header(header.bold()).block(Block::bordered().title(title)), first)
    }
}

/// Colours that can be distinguished with red-green blindness; the name of the status is always shown too.
fn colour(status: Status) -> Color {
    match status {
        Status::Ok => Color::Cyan,
        Status::Warn => Color::Yellow,
        Status::Squeal => Color::Red,
        Status::Fault => Color::Magenta,
        Status::Waiting | Status::NoData | Status::Inactive => Color::Gray,
    }
}

/// A column of the table.
struct Column {
    title: &'static str,
    width: u16,
    /// The text for a mode; the flag says whether the mode is unstable.
    text: fn(&Mode, bool) -> String,
}

/// The columns in order of importance: if space is short, the last are omitted.
static COLUMNS: [Column; 7] = [
    // Unstable modes have a mark, so that they are recognised without colour.
    Column { title: "mode", width: 6, text: |mode, grows| format!("{}{}", if grows { "! " } else { "" }, mode.id) },
    Column { title: "frequency Hz", width: 12, text: |mode, _| significant(mode.frequency_hz, 7) },
    Column {
        title: "growth 1/s",
        width: 11,
        text: |mode, _| above_error(mode.growth_rate_per_s, mode.growth_rate_error_per_s, 4),
    },
    Column {
        title: "damping ratio",
        width: 13,
        text: |mode, _| match is_noise(mode) {
            true => "0".to_owned(),
            false => significant(mode.damping_ratio, 4),
        },
    },
    Column { title: "pad share", width: 9, text: |mode, _| share(mode.pad_participation) },
    Column { title: "+- Hz", width: 8, text: |mode, _| error(mode.frequency_error_hz) },
    Column { title: "+- 1/s", width: 8, text: |mode, _| error(mode.growth_rate_error_per_s) },
];

/// An error bound, rounded to its order of magnitude.
fn error(bound: f64) -> String {
    match bound {
        0.0 => "0".to_owned(),
        _ if bound.is_finite() => format!("{bound:.0e}"),
        _ => "-".to_owned(),
    }
}

/// A share, rounded to a thousandth.
fn share(value: f64) -> String {
    if value.is_finite() { format!("{value:.3}") } else { "-".to_owned() }
}

/// The columns that fit into `width` completely.
fn columns(width: u16) -> &'static [Column] {
    let mut used = 0;
    let fits = |column: &&Column| {
        used += column.width + u16::from(used > 0);
        used <= width
    };
    let count = COLUMNS.iter().take_while(fits).count();
    &COLUMNS[..count.max(1)]
}

/// Whether a growth rate is within its own error bound.
fn is_noise(mode: &Mode) -> bool {
    mode.growth_rate_per_s.abs() <= mode.growth_rate_error_per_s
}

/// The modes in descending order of growth rate. Growth rates within their error bound count as 0; equal ones are in
/// ascending order of frequency.
fn by_growth(modes: &[Mode]) -> Vec<&Mode> {
    let growth = |mode: &Mode| if is_noise(mode) { 0.0 } else { mode.growth_rate_per_s };
    let mut sorted: Vec<&Mode> = modes.iter().collect();
    sorted.sort_by(|a, b| growth(b).total_cmp(&growth(a)).then(a.frequency_hz.total_cmp(&b.frequency_hz)));
    sorted
}

/// Splits a text between words into lines of at most `width` characters; the first line starts after `used` characters.
fn wrapped(text: &str, used: usize, width: usize) -> Vec<String> {
    let words: Vec<String> = text.split_whitespace().map(str::to_owned).collect();
    packed(&words, " ", used, width)
}

/// Distributes items over lines of at most `width` characters without splitting any; the first line starts after `used`
/// characters.
fn packed(items: &[String], gap: &str, used: usize, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = vec![];
    for item in items {
        let before = if lines.len() == 1 { used } else { 0 };
        let length = |line: &String| before + line.chars().count() + gap.len() + item.chars().count();
        let fits = lines.last().is_some_and(|line| length(line) <= width);
        match lines.last_mut().filter(|_| fits) {
            Some(line) => line.extend([gap, item]),
            None => lines.push(item.clone()),
        }
    }
    lines
}

/// Number of `items` that fit into `width` characters one after another.
fn fitting(items: &[String], gap: &str, width: usize) -> usize {
    let mut used = 0;
    let fits = |item: &&String| {
        used += item.chars().count() + if used > 0 { gap.len() } else { 0 };
        used <= width
    };
    items.iter().take_while(fits).count()
}

#[cfg(test)]
pub mod tests {
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;
    use ratatui::buffer::Buffer;

    use super::*;
    use crate::bus::lifecycle::State;
    use crate::msgs::{Header, OperatingPoint, Prediction, Time, level};
    use crate::node::Watch;
    use crate::node::status::InputSources;

    /// What a node shows at each status: 57 modes, of which the 2nd and the 16th grow fastest.
    pub fn snapshot(status: Status) -> Snapshot {
        let watch = Watch::default();
        let header = Header { stamp: Time { sec: 1_700_000_000, nanosec: 250_000_000 }, ..Header::default() };
        let input = OperatingPoint {
            header: header.clone(),
            seq: 7,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: 0.4312,
        };
        let squeals = status == Status::Squeal;
        let mode = |id: u32| {
            let growth_rate_per_s = match id {
                1 if squeals => 20.0,
                15 if squeals => 636.0,
                _ => -1.7e-13,
            };
            let frequency_hz = 700.123456 + 160.96 * f64::from(id);
            let damping_ratio = -growth_rate_per_s / (std::f64::consts::TAU * frequency_hz);
            let errors = (1e-7, 1e-9);
            Mode {
                id,
                frequency_hz: if id == 15 { 3114.6 } else { frequency_hz },
                growth_rate_per_s,
                damping_ratio,
                pad_participation: 0.25,
                frequency_error_hz: errors.0,
                growth_rate_error_per_s: errors.1,
                ..Mode::default()
            }
        };
        let fault = |reason: &str| Prediction {
            header: header.clone(),
            input_seq: 7,
            level: level::FAULT,
            reason: reason.to_owned(),
            friction_margin: f64::NAN,
            ..Prediction::default()
        };
        let prediction = |level, margin: f64, reason: &str| Prediction {
            header: header.clone(),
            input_seq: 7,
            level,
            unstable_modes: if squeals { 2 } else { 0 },
            friction_margin: margin,
            friction_margin_error: 1e-6,
            reason: reason.to_owned(),
            modes: (0..57).map(mode).collect(),
            ..Prediction::default()
        };
        match status {
            Status::Waiting => watch.silence(),
            Status::Ok | Status::Warn | Status::Squeal | Status::Fault | Status::NoData | Status::Inactive => {
                watch.input(&input);
            }
        }
        watch.prediction(&match status {
            Status::Waiting => fault("stale: no input for 1 s"),
            Status::Ok | Status::NoData | Status::Inactive => prediction(level::OK, 0.2, ""),
            Status::Warn => prediction(level::WARN, 0.0312, "friction margin 0.031200 below 0.05"),
            Status::Squeal => prediction(level::SQUEAL, -0.0557, "mode 15 at 3114.6 Hz: damping ratio -0.0325"),
            Status::Fault => fault("normal_load_n is -5, expected 0 to 1000000"),
        });
        if status == Status::Inactive {
            watch.state(State::Inactive);
        }
        if status == Status::NoData {
            watch.silence();
            watch.prediction(&fault("stale: no input for 1 s"));
        }
        let snapshot = watch.snapshot();
        assert_eq!(snapshot.assessment().status, status);
        snapshot
    }

    fn frame() -> Frame {
        Frame {
            title: vec![
                "squealcast (simulated)".to_owned(),
                "tribometer".to_owned(),
                "http://127.0.0.1:8765/".to_owned(),
            ],
            instability_threshold: 1e-6,
            inputs: Some(InputSources {
                places: ["/rig/operating_point (ROS 2, domain 0)", "rig/operating_point (shared memory)"]
                    .map(str::to_owned)
                    .into(),
                start: Some("squealcast simulate".to_owned()),
            }),
            foot: Box::new(|_| vec!["solved 123456".to_owned(), "faults 0".to_owned()]),
            quit: Box::new(|| {}),
        }
    }

    /// The lines of the terminal, the buffer with colours, and the first row.
    fn drawn(status: Status, width: u16, height: u16, first_row: usize) -> (Vec<String>, Buffer, usize) {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("a terminal in memory");
        let (around, snapshot) = (frame(), snapshot(status));
        let mut first = 0;
        let view = View { around: &around, snapshot: &snapshot, note: Some("the chart is not kept"), first_row };
        terminal.draw(|frame| first = view.draw(frame)).expect("it draws");
        let buffer = terminal.backend().buffer().clone();
        let cells: Vec<&str> = buffer.content().iter().map(|cell| cell.symbol()).collect();
        (cells.chunks(usize::from(width)).map(|line| line.concat()).collect(), buffer, first)
    }

    const SIZES: [(u16, u16); 3] = [(80, 24), (40, 24), (200, 60)];

    #[test]
    fn every_status_is_named_and_asserts_only_known_values() {
        for (width, height) in SIZES {
            for status in Status::ALL {
                let (lines, ..) = drawn(status, width, height, 0);
                let text = lines.join("\n");
                assert!(lines[1].contains(&format!(" {} ", status.name())), "{width}:\n{text}");
                let asserted = text.contains("unstable modes") && text.contains("margin");
                assert_eq!(asserted, status.is_known(), "{width} {status:?}:\n{text}");
                assert!(lines[0].contains("simulated"), "{width}:\n{text}");
                assert!(text.contains("the chart is not kept") && text.contains("q quits"), "{width}:\n{text}");
                assert!(text.contains("http://127.0.0.1:8765/"), "where the page is: {width}:\n{text}");
                let names_the_topic = text.contains("/rig/operating_point") && text.contains("squealcast");
                assert_eq!(names_the_topic, status == Status::Waiting, "{width} {status:?}:\n{text}");
                assert!(!text.contains("stale: no input for"), "a reason that does not age: {width}:\n{text}");
            }
        }
        let (lines, ..) = drawn(Status::NoData, 80, 24, 0);
        assert!(lines[2].contains("last input 0.") && lines[2].contains("s ago"), "{}", lines[2]);
    }

    #[test]
    fn unstable_modes_are_on_top_red_and_marked_at_any_scroll_position() {
        for (width, height) in SIZES {
            for first_row in [0, 3, usize::MAX] {
                let (lines, buffer, first) = drawn(Status::Squeal, width, height, first_row);
                let text = lines.join("\n");
                let marked: Vec<usize> = (0..lines.len()).filter(|&k| lines[k].contains("! ")).collect();
                let [fastest, slower] = marked[..] else { panic!("{width} {first_row}:\n{text}") };
                assert!(lines[fastest].contains("! 15") && lines[fastest].contains("3114.600"), "{text}");
                assert!(lines[slower].contains("! 1 ") && lines[slower].contains("20.00"), "{text}");
                for (y, line) in lines.iter().enumerate().skip(fastest).take(3) {
                    let red = (1..width - 1).any(|x| buffer[(x, y as u16)].fg == Color::Red);
                    assert_eq!(red, marked.contains(&y), "{line}");
                }
                assert!(first <= 55, "the first row is clamped: {first}");
                if first_row == usize::MAX {
                    assert!(text.contains("   56 "), "the end is reached:\n{text}");
                }
            }
        }
    }

    #[test]
    fn columns_are_dropped_whole_and_rounding_noise_is_zero() {
        let (narrow, ..) = drawn(Status::Ok, 40, 24, 0);
        let (wide, ..) = drawn(Status::Ok, 80, 24, 0);
        let header = |lines: &[String]| lines.iter().find(|line| line.contains("frequency Hz")).cloned();
        assert_eq!(
            header(&narrow).expect("a header").split_whitespace().collect::<String>(),
            "│modefrequencyHzgrowth1/s│"
        );
        assert!(header(&wide).expect("a header").contains("damping ratio pad share    +- Hz   +- 1/s"), "{wide:?}");
        for lines in [&narrow, &wide] {
            let row = lines.iter().find(|line| line.contains("700.1235")).expect("the first mode");
            let values: Vec<&str> = row.split_whitespace().collect();
            assert_eq!(values[1..4], ["0", "700.1235", "0"], "{row}");
            assert!(!lines.iter().any(|line| line.contains("e-13")), "{lines:?}");
            assert!(lines.iter().any(|line| line.contains("margin 0.2000 +- 1e-6")), "{lines:?}");
        }
        assert!(wide.iter().any(|line| line.contains("modes 1 to") && line.contains("of 57")), "{wide:?}");
    }

    #[test]
    fn no_text_is_cut_in_a_small_window() {
        for (width, height) in [(1, 1), (2, 3), (10, 5), (20, 8)] {
            for status in Status::ALL {
                drawn(status, width, height, usize::MAX);
            }
        }
        assert_eq!(wrapped("one two three", 4, 9), ["one", "two three"]);
        assert_eq!(packed(&["a b".to_owned(), "c".to_owned()], "   ", 0, 6), ["a b", "c"]);
        assert_eq!(fitting(&["ab".to_owned(), "cd".to_owned(), "e".to_owned()], "--", 6), 2);
    }
}
