//! `[contact_state]`: contact pairs that open and close with the state of steady sliding.
//!
//! The law gives the force `N` of a pair as a function of its closure `δ`; `k` is the `stiffness_n_per_m` of the pair, `A`
//! its `area_m2`:
//!
//! ```text
//! linear        N = k δ for δ > 0                  exponential   N = A p_0 e^{δ/σ}
//! power         N = k d_0 (δ/d_0)^m for δ > 0      table         N = A p(δ), p interpolated
//! ```

use super::RigError;
use super::inline::{describe_pairs, modal_row};
use super::lines::{self, Lines, found};
use super::modal::Part;
use super::npz;
use super::patch::{Pair, dot};
use super::raw::{OneOrMany, RawContactState, RawRig};
use super::settings::{Settings, at_most, spread, within};
use super::source::Source;
use crate::contact::{
    FreeModes, MeasuredLoad, PressureLaw, PressureTable, ResponseError, StaticResponse, Statics, StaticsError,
    StaticsParts, TableError, TruncatedResponse,
};
use crate::physics::{ContactPairs, ContactState, ResidualFlexibility};
use crate::reduction::Modes;

/// Most contact pairs with a state: every state factorises a matrix of this size.
const MOST_PAIRS: usize = 2000;
/// Most points of a table of pressures.
const MOST_POINTS: usize = 1000;
/// Number of loads over the chart's range, at equal ratios, and of steps in the friction coefficient up to the end of the
/// search, at which anchors are computed before the first prediction. Other states start from them.
const ANCHOR_LOADS: u32 = 6;
const ANCHOR_STEPS: u32 = 8;

/// The table `[contact_state]`, checked as far as it does not depend on the parts.
#[derive(Clone, Debug)]
pub struct StateTable {
    file: String,
    law: PressureLaw,
    measured: MeasuredLoad,
    raw: RawContactState,
}

/// The load of 1 N on the modes of both sides.
pub(super) struct Load {
    /// The key that gives it, for errors.
    pub field: &'static str,
    /// Generalised force in each coordinate, kg^-1/2.
    coordinates: Vec<f64>,
    /// Response of the gaps to the load by the truncated modes, m/N; with residual flexibility only.
    residual_gap_m_per_n: Option<Vec<f64>>,
}

/// Reads `[contact_state]` of a rig file, if it has one.
///
/// # Errors
/// [`RigError`], naming file, key, value and limit.
pub(super) fn read(source: &mut Source<'_>, raw: &RawRig) -> Result<Option<StateTable>, RigError> {
    let Some(raw) = &raw.contact_state else { return Ok(None) };
    let file = source.rig_file.clone();
    check(&file, raw, &mut |field, name| read_table(name, source.read(field, name)?)).map(Some)
}

/// Checks the table `[contact_state]` of `file`. `pressures` reads the table of pressures that a field names.
///
/// # Errors
/// [`RigError`], naming file, key, value and limit.
pub fn check(
    file: &str,
    raw: &RawContactState,
    pressures: &mut dyn FnMut(&str, &str) -> Result<PressureTable, RigError>,
) -> Result<StateTable, RigError> {
    let file = file.to_owned();
    let unknown = |key: &str, value: &str, limit: &str| {
        let (field, value, limit) = (format!("contact_state.{key}"), format!("\"{value}\""), limit.to_owned());
        Err(RigError::Range { file: file.clone(), field, value, limit })
    };
    let measured = match raw.measured.as_str() {
        "contact-force" => MeasuredLoad::Contact,
        "back-force" => MeasuredLoad::Back,
        other => return unknown("measured", other, "\"contact-force\" or \"back-force\""),
    };
    let given: [(&'static str, bool); 6] = [
        ("exponent", raw.exponent.is_some()),
        ("reference_m", raw.reference_m.is_some()),
        ("roughness_m", raw.roughness_m.is_some()),
        ("pressure_pa", raw.pressure_pa.is_some()),
        ("table", raw.table.is_some()),
        ("area_m2", raw.area_m2.is_some()),
    ];
    // Keys that the law needs, and those it may have.
    let (needs, may): (&[&str], &[&str]) = match raw.law.as_str() {
        "linear" => (&[], &[]),
        "power" => (&["exponent", "reference_m"], &["roughness_m"]),
        "exponential" => (&["pressure_pa", "roughness_m", "area_m2"], &[]),
        "table" => (&["table", "area_m2"], &[]),
        other => return unknown("law", other, "\"linear\", \"power\", \"exponential\" or \"table\""),
    };
    for (key, is_given) in given {
        let field = format!("contact_state.{key}");
        if needs.contains(&key) && !is_given {
            let limit = format!("it for the law \"{}\"", raw.law);
            return Err(RigError::MissingKey { file, field, limit });
        }
        if is_given && !needs.contains(&key) && !may.contains(&key) {
            let all: Vec<&str> = needs.iter().chain(may).copied().collect();
            let value = format!("has nothing to act on in the law \"{}\"", raw.law);
            let limit = if all.is_empty() { "no further key of a law".to_owned() } else { all.join(", ") };
            return Err(RigError::Kind { file, field, value, limit });
        }
    }
    let number = |key: &str, value: Option<f64>| (format!("contact_state.{key}"), value.unwrap_or_default());
    let positive = |(field, value): (String, f64)| within(&file, &field, value, value > 0.0, "more than 0");
    let law = match raw.law.as_str() {
        "power" => {
            let (field, exponent) = number("exponent", raw.exponent);
            let (rough, roughness_m) = number("roughness_m", raw.roughness_m);
            PressureLaw::Power {
                stiffness: 1.0,
                reference_m: positive(number("reference_m", raw.reference_m))?,
                exponent: within(&file, &field, exponent, (1.0..=10.0).contains(&exponent), "1 to 10")?,
                roughness_m: within(&file, &rough, roughness_m, roughness_m >= 0.0, "at least 0")?,
            }
        }
        "exponential" => PressureLaw::Exponential {
            pressure: positive(number("pressure_pa", raw.pressure_pa))?,
            roughness_m: positive(number("roughness_m", raw.roughness_m))?,
        },
        "table" => {
            let name = raw.table.as_deref().unwrap_or_default();
            let table = pressures("contact_state.table", name)?;
            PressureLaw::Table(match raw.table_closures_times {
                Some(factor) => table.with_closures_times(factor).map_err(|error| in_file(name, error))?,
                None => table,
            })
        }
        _ => PressureLaw::Linear { stiffness: 1.0 },
    };
    Ok(StateTable { file, law, measured, raw: raw.clone() })
}

/// Reads a table `closure_m,pressure_pa`.
///
/// # Errors
/// [`RigError::Line`], [`RigError::Range`], [`RigError::ContactState`].
pub fn read_table(file: &str, bytes: &[u8]) -> Result<PressureTable, RigError> {
    const HEADER: &str = "closure_m,pressure_pa";
    let mut input = Lines::new(file, bytes);
    let header = input.advance()?.map(|(_, text)| text.replace([' ', '\t'], "")).unwrap_or_default();
    if header != HEADER {
        return Err(input.refuse("header", found(&header), HEADER));
    }
    let (mut closure_m, mut pressure_pa) = (vec![], vec![]);
    while let Some((line, text)) = input.advance()? {
        if text.is_empty() {
            continue;
        }
        let values = text.split_once(',').and_then(|(closure, pressure)| {
            let number = |cell: &str| cell.trim().parse::<f64>().ok().filter(|value| value.is_finite());
            Some((number(closure)?, number(pressure)?))
        });
        let Some((closure, pressure)) = values else {
            let limit = "two finite numbers, closure in m and pressure in Pa";
            return Err(lines::refuse(file, line, "point", found(text), limit));
        };
        at_most(file, "points", closure_m.len() + 1, MOST_POINTS)?;
        closure_m.push(closure);
        pressure_pa.push(pressure);
    }
    PressureTable::new(&closure_m, &pressure_pa).map_err(|error| in_file(file, error))
}

fn in_file(file: &str, error: TableError) -> RigError {
    RigError::ContactState { file: file.to_owned(), source: StaticsError::Law(error.into()) }
}

impl StateTable {
    fn kind(&self, key: &str, value: &str, limit: &str) -> RigError {
        let (field, value, limit) = (format!("contact_state.{key}"), value.to_owned(), limit.to_owned());
        RigError::Kind { file: self.file.clone(), field, value, limit }
    }

    fn missing(&self, key: &str, limit: &str) -> RigError {
        let (field, limit) = (format!("contact_state.{key}"), limit.to_owned());
        RigError::MissingKey { file: self.file.clone(), field, limit }
    }

    /// The load of an inline rig, `load_pad`: a row over the degrees of freedom of the pad.
    ///
    /// # Errors
    /// [`RigError`].
    pub(super) fn load_on_inline(&self, pad: &Modes, disc: Option<&Modes>) -> Result<Load, RigError> {
        if self.raw.residual_gap_m_per_n.is_some() {
            return Err(self.no_residual("inline substructures have no residual flexibility"));
        }
        self.loaded_by("inline substructures", &["load_pad"])?;
        let row = self.raw.load_pad.as_ref();
        let mut coordinates = modal_row(&self.file, "contact_state.load_pad", row, Some(pad), true, 1.0)?;
        coordinates.resize(pad.phi.ncols() + disc.map_or(0, |disc| disc.phi.ncols()), 0.0);
        Ok(Load { field: "load_pad", coordinates, residual_gap_m_per_n: None })
    }

    /// The load of a rig of modes: `load_coordinates`, or the array `load` of the pad's archive, one value for each mode
    /// of the archive. The rig has `disc_modes` further coordinates, and residual flexibility if it is `flexible`.
    ///
    /// # Errors
    /// [`RigError`].
    pub(super) fn load_on_modes(
        &self,
        pad: &Part,
        disc_modes: usize,
        pairs: &[Pair],
        flexible: bool,
    ) -> Result<Load, RigError> {
        self.loaded_by("modal substructures", &["load_coordinates", "residual_gap_m_per_n"])?;
        let field = "contact_state.load_coordinates";
        let modes = pad.data.omega_rad_s.len();
        let loads = match (&self.raw.load_coordinates, &pad.data.load) {
            (Some(_), Some(_)) => {
                let value = "is given beside the array `load` of pad.modal";
                return Err(self.kind("load_coordinates", value, "one of the two"));
            }
            (Some(values), None) => {
                spread(&self.file, field, &OneOrMany::Many(values.clone()), modes, "modes of pad.modal")?
            }
            (None, Some(values)) => values.clone(),
            (None, None) => {
                let limit = "one value for each mode of pad.modal, or the array `load` there";
                return Err(self.missing("load_coordinates", limit));
            }
        };
        let mut coordinates: Vec<f64> = pad.selected.iter().map(|&mode| loads[mode]).collect();
        coordinates.resize(pad.selected.len() + disc_modes, 0.0);
        let residual_gap_m_per_n = match (&self.raw.residual_gap_m_per_n, flexible) {
            (None, false) => None,
            (Some(_), false) => return Err(self.no_residual("the rig has no residual flexibility")),
            (None, true) => {
                let limit = "the change of each gap per N of the load by the truncated modes, because the rig has \
                             residual flexibility";
                return Err(self.missing("residual_gap_m_per_n", limit));
            }
            (Some(values), true) => {
                let field = "contact_state.residual_gap_m_per_n";
                let mut gaps = spread(&self.file, field, values, pairs.len(), "contact pairs")?;
                // The residual flexibility of the pad includes the modes of the archive that are not selected.
                let omitted = (0..modes).filter(|mode| pad.data.residual.is_some() && !pad.selected.contains(mode));
                for mode in omitted {
                    let response = loads[mode] / pad.data.omega_rad_s[mode].powi(2);
                    for (gap, pair) in gaps.iter_mut().zip(pairs) {
                        *gap += response * dot(pair.normal, pad.data.shape(pair.pad_node, mode));
                    }
                }
                Some(gaps)
            }
        };
        Ok(Load { field: "load_coordinates", coordinates, residual_gap_m_per_n })
    }

    /// Checks that no key but those listed gives the load of `what`.
    ///
    /// # Errors
    /// [`RigError::Kind`].
    pub fn loaded_by(&self, what: &str, keys: &[&str]) -> Result<(), RigError> {
        let RawContactState { load_pad, load_coordinates, residual_gap_m_per_n, statics, .. } = &self.raw;
        let RawContactState { load_file, load_nodes, load_direction, .. } = &self.raw;
        let given = [
            ("load_pad", load_pad.is_some()),
            ("load_coordinates", load_coordinates.is_some()),
            ("residual_gap_m_per_n", residual_gap_m_per_n.is_some()),
            ("statics", statics.is_some()),
            ("load_file", load_file.is_some()),
            ("load_nodes", load_nodes.is_some()),
            ("load_direction", load_direction.is_some()),
        ];
        match given.iter().find(|(key, is_given)| *is_given && !keys.contains(key)) {
            Some((key, _)) => Err(self.kind(key, &format!("is given for {what}"), keys[0])),
            None => Ok(()),
        }
    }

    fn no_residual(&self, why: &str) -> RigError {
        self.kind("residual_gap_m_per_n", &format!("has nothing to act on: {why}"), "no such key")
    }

    /// The statics of the contact. `omega` are the natural frequencies of the coordinates without contact, rad/s.
    ///
    /// # Errors
    /// [`RigError`].
    pub(super) fn statics(
        &self,
        omega: &[f64],
        pairs: &ContactPairs,
        residual: Option<&ResidualFlexibility>,
        load: &Load,
        settings: &Settings,
    ) -> Result<Statics, RigError> {
        self.check_pairs(&pairs.stiffness_n_per_m)?;
        let omega_squared: Vec<f64> = omega.iter().map(|omega| omega * omega).collect();
        let modes = FreeModes {
            omega_squared: &omega_squared,
            normal: pairs.normal.as_ref(),
            sliding: pairs.sliding.as_ref(),
            load: &load.coordinates,
        };
        let truncated = residual.zip(load.residual_gap_m_per_n.as_ref()).map(|(residual, gap_per_load)| {
            TruncatedResponse { normal: residual.normal.as_ref(), sliding: residual.sliding.as_ref(), gap_per_load }
        });
        let response = StaticResponse::from_modes(&modes, truncated.as_ref()).map_err(|error| match error {
            ResponseError::Shape { .. } | ResponseError::Frequency { .. } => {
                self.kind("law", &format!("has no statics: {error}"), "parts with a static response")
            }
        })?;
        self.statics_of(response, &pairs.stiffness_n_per_m, settings)
    }

    /// Checks the number of contact pairs, and whatever is given for each of them. `stiffness_n_per_m` is that of each pair.
    ///
    /// # Errors
    /// [`RigError`].
    pub fn check_pairs(&self, stiffness_n_per_m: &[f64]) -> Result<(), RigError> {
        at_most(&self.file, "contact pairs with [contact_state]", stiffness_n_per_m.len(), MOST_PAIRS)?;
        self.area_and_gap(stiffness_n_per_m).map(|_| ())
    }

    /// Area, or factor of the law, and initial gap (m) of each pair.
    fn area_and_gap(&self, stiffness_n_per_m: &[f64]) -> Result<[Vec<f64>; 2], RigError> {
        let (file, count) = (self.file.as_str(), stiffness_n_per_m.len());
        let per_pair = |key: &str, values: &OneOrMany| {
            spread(file, &format!("contact_state.{key}"), values, count, "contact pairs")
        };
        let area = match &self.raw.area_m2 {
            Some(values) => per_pair("area_m2", values)?,
            None => stiffness_n_per_m.to_vec(),
        };
        let of_area = if self.raw.area_m2.is_some() { "contact_state.area_m2" } else { "stiffness_n_per_m" };
        for (pair, &value) in area.iter().enumerate() {
            let field = format!("{of_area} of contact pair {pair}");
            within(file, &field, value, value > 0.0, "more than 0, because it scales the law of [contact_state]")?;
        }
        let gap_m = match &self.raw.gap_m {
            Some(values) => per_pair("gap_m", values)?,
            None => vec![0.0; count],
        };
        Ok([area, gap_m])
    }

    /// The statics of contact pairs with the static `response`.
    ///
    /// # Errors
    /// [`RigError`].
    pub fn statics_of(
        &self,
        response: StaticResponse,
        stiffness_n_per_m: &[f64],
        settings: &Settings,
    ) -> Result<Statics, RigError> {
        let [area, gap_m] = self.area_and_gap(stiffness_n_per_m)?;
        let parts = StaticsParts { law: self.law.clone(), area, gap_m, response, measured: self.measured };
        let [low, high] = settings.chart.normal_load_n;
        let loads: Vec<f64> =
            (0..ANCHOR_LOADS).map(|k| low * (high / low).powf(f64::from(k) / f64::from(ANCHOR_LOADS - 1))).collect();
        // In the direction of rotation of the reference; in the other one, states are continued from 0.
        let last = settings.mu_max.copysign(settings.reference.disc_speed_rad_s);
        let s_mus: Vec<f64> = (0..=ANCHOR_STEPS).map(|k| last * f64::from(k) / f64::from(ANCHOR_STEPS)).collect();
        Ok(Statics::new(parts).map_err(|source| self.refuse(source))?.with_anchors(&loads, &s_mus))
    }

    /// The statics of a rig on a shared basis, from the archive that the key `statics` names.
    ///
    /// # Errors
    /// [`RigError`].
    pub(super) fn statics_on_basis(
        &self,
        source: &mut Source<'_>,
        stiffness_n_per_m: &[f64],
        settings: &Settings,
    ) -> Result<Statics, RigError> {
        self.loaded_by("a shared basis", &["statics"])?;
        self.check_pairs(stiffness_n_per_m)?;
        let Some(name) = &self.raw.statics else {
            return Err(self.missing("statics", "an .npz archive of the static response, which `reduce` writes"));
        };
        let bytes = source.read("contact_state.statics", name)?;
        self.statics_of(npz::read_static_response(name, bytes, stiffness_n_per_m.len())?, stiffness_n_per_m, settings)
    }

    /// Checks that the load presses the pad on the disc; `key` gives it. Returns the load at which it was checked, N.
    ///
    /// # Errors
    /// [`RigError::ContactState`] if there is no state without friction; [`RigError::Range`] if the contact force does not
    /// grow with the load.
    pub fn check_load(&self, key: &str, statics: &Statics, settings: &Settings) -> Result<f64, RigError> {
        let reference = &settings.reference;
        let [lowest, _] = settings.chart.normal_load_n;
        let load_n = if reference.normal_load_n > 0.0 { reference.normal_load_n } else { lowest };
        // By the force on the back, which follows the sign of the load vector.
        let at_rest =
            self.plain(statics, MeasuredLoad::Back)?.state(load_n, 0.0).map_err(|source| self.refuse(source))?;
        let slope: f64 = at_rest.per_load.force.iter().sum();
        if slope.is_nan() || slope <= 0.0 {
            return Err(RigError::Range {
                file: self.file.clone(),
                field: format!("contact_state.{key}"),
                value: format!("a load that changes the contact force by {slope} N per N at {load_n} N"),
                limit: "more than 0: a load that presses the pad on the disc".to_owned(),
            });
        }
        Ok(load_n)
    }

    /// The statics without anchors, which cost more than a few states.
    fn plain(&self, statics: &Statics, measured: MeasuredLoad) -> Result<Statics, RigError> {
        Statics::new(StaticsParts { measured, ..statics.parts().clone() }).map_err(|source| self.refuse(source))
    }

    fn refuse(&self, source: StaticsError) -> RigError {
        RigError::ContactState { file: self.file.clone(), source }
    }

    /// Lines for [`super::Rig::describe`]. Refuses a load that does not press the pad on the disc.
    ///
    /// # Errors
    /// [`RigError::ContactState`] if there is no state without friction; [`RigError::Range`] if the contact force does not
    /// grow with the load.
    pub(super) fn describe(
        &self,
        load: &str,
        statics: &Statics,
        pairs: &ContactPairs,
        settings: &Settings,
    ) -> Result<Vec<String>, RigError> {
        let reference = &settings.reference;
        let load_n = self.check_load(load, statics, settings)?;
        let friction = match reference.contact_state() {
            ContactState::Sliding => reference.disc_speed_rad_s.signum() * reference.friction_coefficient,
            ContactState::NotSliding | ContactState::Open => 0.0,
        };
        let mut line = format!("state      {} pairs", statics.pairs());
        let plain = self.plain(statics, self.measured)?;
        for (index, s_mu) in [0.0, friction].into_iter().enumerate() {
            let closed = match plain.state(load_n, s_mu) {
                Ok(state) => format!("{} closed", state.pairs_closed()),
                Err(StaticsError::NoEquilibrium { end, .. }) => format!("none in steady sliding, because {end},"),
                Err(error) => return Err(self.refuse(error)),
            };
            match index {
                0 => line += &format!(": {closed} at {load_n} N without friction"),
                _ if s_mu != 0.0 => line += &format!(", {closed} at friction coefficient {s_mu}"),
                _ => {}
            }
        }
        let contact = match &self.raw.area_m2 {
            Some(_) => {
                let area: f64 = statics.parts().area.iter().sum();
                format!("contact    {} pairs, in all {area:.6e} m²", statics.pairs())
            }
            None => describe_pairs(pairs),
        };
        Ok(vec![contact, self.describe_law(), line])
    }

    /// The contact law and what the load is, as a line of text.
    pub fn describe_law(&self) -> String {
        let measured = match self.measured {
            MeasuredLoad::Contact => "the contact force",
            MeasuredLoad::Back => "the force on the pad's back",
        };
        let law = match &self.law {
            PressureLaw::Linear { .. } => "linear springs that only push".to_owned(),
            PressureLaw::Power { reference_m, exponent, roughness_m, .. } => {
                let rounded = match roughness_m {
                    0.0 => String::new(),
                    height => format!(", rounded over {height:e} m"),
                };
                format!("power {exponent} of the closure, secant stiffness at {reference_m:e} m{rounded}")
            }
            PressureLaw::Exponential { pressure, roughness_m } => {
                format!("exponential, {pressure:e} Pa at closure 0, roughness height {roughness_m:e} m")
            }
            PressureLaw::Table(table) => format!(
                "table {} up to a closure of {:e} m",
                self.raw.table.as_deref().unwrap_or_default(),
                table.last_closure_m()
            ),
        };
        format!("law        {law}; the load is {measured}")
    }
}
