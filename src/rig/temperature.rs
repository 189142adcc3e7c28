//! `[temperature]`: how contact stiffness, contact damping and friction slope follow the temperature of the contact.
//!
//! Each of the three is multiplied by a factor, piecewise linear between the points of a table and constant beyond them. The
//! factor is 1 at the reference temperature, for which the rig file is written. A temperature changes no law of the model: a
//! rig at another temperature is built from its files again, with the factors on the numbers in them.

use super::raw::{OneOrMany, RawRig};
use super::settings::{at_most, finite, within};
use super::{Rig, RigError};

/// Temperatures that are accepted, °C: from absolute zero to beyond any friction material.
pub const RANGE_C: [f64; 2] = [-273.15, 3000.0];
/// Most points of a table of factors.
const MOST_POINTS: usize = 1000;
/// Largest difference of a factor from 1 at the reference temperature.
const ONE: f64 = 1e-9;

/// `[temperature]`: each table lists temperatures in °C, ascending, with the factor there.
#[derive(Clone, Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawTemperature {
    reference_c: f64,
    contact_stiffness: Option<Vec<[f64; 2]>>,
    contact_damping: Option<Vec<[f64; 2]>>,
    friction_slope: Option<Vec<[f64; 2]>>,
}

/// Factors at one temperature.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Factors {
    pub contact_stiffness: f64,
    pub contact_damping: f64,
    pub friction_slope: f64,
}

impl Factors {
    const ONE: Self = Self { contact_stiffness: 1.0, contact_damping: 1.0, friction_slope: 1.0 };
}

/// The table `[temperature]` of a rig, and the temperature that the rig has.
#[derive(Clone, Debug, PartialEq)]
pub struct Temperature {
    reference_c: f64,
    /// Points of each table, in the order of [`Temperature::TABLES`]; empty for a factor of 1.
    points: [Vec<[f64; 2]>; 3],
    present_c: f64,
}

/// Checks that a temperature is one of [`RANGE_C`]; `field` names it in the error.
///
/// # Errors
/// [`RigError::NotFinite`], [`RigError::Range`].
pub fn check(file: &str, field: &str, temperature_c: f64) -> Result<f64, RigError> {
    let [low, high] = RANGE_C;
    let limit = format!("{low} to {high} °C");
    within(file, field, temperature_c, (low..=high).contains(&temperature_c), &limit)
}

impl Temperature {
    /// The keys of the tables.
    const TABLES: [&'static str; 3] = ["contact_stiffness", "contact_damping", "friction_slope"];

    /// Checks the table; the rig is at its reference temperature.
    ///
    /// # Errors
    /// [`RigError`].
    pub(super) fn read(file: &str, raw: &RawRig) -> Result<Option<Self>, RigError> {
        let Some(table) = &raw.temperature else { return Ok(None) };
        let field = |key: &str| format!("temperature.{key}");
        let reference_c = check(file, &field("reference_c"), table.reference_c)?;
        let RawTemperature { reference_c: _, contact_stiffness, contact_damping, friction_slope } = table;
        let given = [contact_stiffness, contact_damping, friction_slope];
        if given.iter().all(|points| points.is_none()) {
            let (file, field) = (file.to_owned(), "temperature".to_owned());
            return Err(RigError::MissingKey { file, field, limit: format!("a table {}", Self::TABLES.join(", ")) });
        }
        let mut points: [Vec<[f64; 2]>; 3] = Default::default();
        for ((key, given), points) in Self::TABLES.into_iter().zip(given).zip(&mut points) {
            let Some(given) = given else { continue };
            if let Some(why) = nothing_to_act_on(key, raw) {
                let (file, field, limit) = (file.to_owned(), field(key), "no such key".to_owned());
                return Err(RigError::Kind { file, field, value: format!("has nothing to act on: {why}"), limit });
            }
            check_points(file, &field(key), given, reference_c)?;
            points.clone_from(given);
        }
        Ok(Some(Self { reference_c, points, present_c: reference_c }))
    }

    /// The same table for a rig at `present_c`.
    pub(super) fn at(&self, present_c: f64) -> Self {
        Self { present_c, ..self.clone() }
    }

    /// The temperature for which the rig file is written, °C.
    pub fn reference_c(&self) -> f64 {
        self.reference_c
    }

    /// The temperature that the rig has, °C.
    pub fn present_c(&self) -> f64 {
        self.present_c
    }

    /// The factors at the present temperature.
    pub fn factors(&self) -> Factors {
        if self.present_c == self.reference_c {
            return Factors::ONE;
        }
        let [contact_stiffness, contact_damping, friction_slope] =
            self.points.each_ref().map(|points| factor_at(points, self.present_c));
        Factors { contact_stiffness, contact_damping, friction_slope }
    }

    /// Whether the present temperature is beyond the points of a table, where its factor stays constant.
    pub fn is_beyond_a_table(&self) -> bool {
        let beyond = |points: &Vec<[f64; 2]>| match (points.first(), points.last()) {
            (Some([low, _]), Some([high, _])) => !(*low..=*high).contains(&self.present_c),
            _ => false,
        };
        self.points.iter().any(beyond)
    }

    /// Multiplies the numbers of a rig file by the factors at the present temperature. At every force, a contact pair is then
    /// `contact_stiffness` times as stiff: laws of `[contact_state]` are stretched along the closure.
    pub(super) fn apply(&self, raw: &mut RawRig) {
        let Factors { contact_stiffness, contact_damping, friction_slope } = self.factors();
        if self.present_c == self.reference_c {
            return;
        }
        for contact in raw.contact.iter_mut().flatten() {
            contact.stiffness_n_per_m *= contact_stiffness;
            contact.damping_n_s_per_m *= contact_damping;
        }
        for patch in raw.contact_patch.iter_mut().flatten() {
            times(&mut patch.stiffness_n_per_m, contact_stiffness);
            times(&mut patch.damping_n_s_per_m, contact_damping);
        }
        if let Some(state) = &mut raw.contact_state {
            let closures = state.reference_m.iter_mut().chain(&mut state.roughness_m);
            closures.for_each(|closure_m| *closure_m /= contact_stiffness);
            state.table_closures_times = Some(1.0 / contact_stiffness);
        }
        raw.friction.slope_s_per_m *= friction_slope;
        raw.friction.stribeck_drop *= friction_slope;
    }

    /// The tables and the present temperature, as lines of text.
    pub(super) fn describe(&self) -> Vec<String> {
        let tables = Self::TABLES.into_iter().zip(&self.points).filter_map(|(key, points)| {
            let (first, last) = (points.first()?, points.last()?);
            let name = key.replace('_', " ");
            Some(format!("{name} times {} at {} °C to {} at {} °C", first[1], first[0], last[1], last[0]))
        });
        let tables: Vec<String> = tables.collect();
        let mut lines = vec![format!("heat       {}; 1 at {} °C", tables.join("; "), self.reference_c)];
        if self.present_c != self.reference_c {
            let Factors { contact_stiffness, contact_damping, friction_slope } = self.factors();
            lines.push(format!(
                "heat       at {} °C: contact stiffness times {contact_stiffness}, contact damping times \
                 {contact_damping}, friction slope times {friction_slope}",
                self.present_c
            ));
        }
        lines
    }
}

impl Rig {
    /// The rig at another temperature, built from its files again. Its hash stays that of the files.
    ///
    /// # Errors
    /// [`RigError::MissingKey`] if the rig has no `[temperature]`; [`RigError`] if the temperature is out of range or takes
    /// the contact out of range.
    pub fn at_temperature(&self, temperature_c: f64) -> Result<Self, RigError> {
        self.accepts_temperature(temperature_c)?;
        Ok(Self { path: self.path.clone(), ..Self::from_files_at(&self.files, Some(temperature_c))? })
    }

    /// Checks that the rig follows the temperature, and that this one is in range.
    ///
    /// # Errors
    /// [`RigError::MissingKey`], [`RigError::NotFinite`], [`RigError::Range`].
    pub fn accepts_temperature(&self, temperature_c: f64) -> Result<(), RigError> {
        if self.temperature.is_none() {
            return Err(RigError::MissingKey {
                file: self.name.clone(),
                field: "temperature".to_owned(),
                limit: "the table [temperature], which says what follows the temperature".to_owned(),
            });
        }
        check(&self.name, "temperature_c", temperature_c).map(|_| ())
    }

    /// The temperature that the rig has, °C; `None` without `[temperature]`.
    pub fn temperature_c(&self) -> Option<f64> {
        self.temperature.as_ref().map(Temperature::present_c)
    }
}

/// Why a rig has nothing that the table `key` could change; `None` if it has.
fn nothing_to_act_on(key: &str, raw: &RawRig) -> Option<&'static str> {
    if raw.system.is_some() {
        return Some("a system of matrices has no contact pairs");
    }
    let any = |values: &OneOrMany| match values {
        OneOrMany::One(value) => *value != 0.0,
        OneOrMany::Many(values) => values.iter().any(|value| *value != 0.0),
    };
    let damped = raw.contact.iter().flatten().any(|contact| contact.damping_n_s_per_m != 0.0)
        || raw.contact_patch.iter().flatten().any(|patch| any(&patch.damping_n_s_per_m));
    let sloped = raw.friction.slope_s_per_m != 0.0 || raw.friction.stribeck_drop != 0.0;
    match key {
        "contact_damping" if !damped => Some("damping_n_s_per_m of every contact pair is 0"),
        "friction_slope" if !sloped => Some("[friction] gives no slope"),
        _ => None,
    }
}

/// Checks the points of a table: temperatures ascend, factors are positive, and the factor at the reference temperature,
/// between the first and the last point, is 1.
fn check_points(file: &str, field: &str, points: &[[f64; 2]], reference_c: f64) -> Result<(), RigError> {
    at_most(file, field, points.len(), MOST_POINTS)?;
    let refuse = |value: String, limit: String| {
        Err(RigError::Range { file: file.to_owned(), field: field.to_owned(), value, limit })
    };
    if points.len() < 2 {
        return refuse(format!("{} points", points.len()), "at least 2".to_owned());
    }
    for (index, &[temperature_c, factor]) in points.iter().enumerate() {
        let at = |column: usize| format!("{field}[{index}][{column}]");
        check(file, &at(0), temperature_c)?;
        if let Some([before_c, _]) = index.checked_sub(1).map(|before| points[before]) {
            let limit = format!("more than {before_c} °C, the temperature before it");
            within(file, &at(0), temperature_c, temperature_c > before_c, &limit)?;
        }
        within(file, &at(1), factor, factor > 0.0, "more than 0")?;
    }
    let (low, high) = (points[0][0], points[points.len() - 1][0]);
    if !(low..=high).contains(&reference_c) {
        return refuse(format!("given from {low} to {high} °C"), format!("a range with reference_c = {reference_c}"));
    }
    let at_reference = finite(file, field, factor_at(points, reference_c))?;
    if (at_reference - 1.0).abs() > ONE {
        return refuse(format!("{at_reference} at reference_c = {reference_c}"), "1 there".to_owned());
    }
    Ok(())
}

/// The factor at a temperature: linear between points, constant beyond them, 1 without any.
fn factor_at(points: &[[f64; 2]], temperature_c: f64) -> f64 {
    let (Some(first), Some(last)) = (points.first(), points.last()) else { return 1.0 };
    let above = points.partition_point(|[at_c, _]| *at_c < temperature_c);
    match (above.checked_sub(1).map(|below| points[below]), points.get(above)) {
        (None, _) => first[1],
        (_, None) => last[1],
        (Some([low_c, low]), Some(&[high_c, high])) => {
            let share = (temperature_c - low_c) / (high_c - low_c);
            if share == 1.0 { high } else { low + (high - low) * share }
        }
    }
}

/// Multiplies a value, or every value of a list.
fn times(values: &mut OneOrMany, factor: f64) {
    match values {
        OneOrMany::One(value) => *value *= factor,
        OneOrMany::Many(values) => values.iter_mut().for_each(|value| *value *= factor),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::{Solver, Vectors};
    use crate::rig::RigFile;

    fn rig(text: &str) -> Result<Rig, RigError> {
        Rig::from_files(&[RigFile { name: "rig.toml".to_owned(), bytes: text.as_bytes().to_vec() }])
    }

    /// Two degrees of freedom against a rigid disc, with damping and a slope. `more` ends the file.
    fn inline(stiffness: f64, damping: f64, slope: f64, more: &str) -> Result<Rig, RigError> {
        rig(&format!(
            "name = \"two\"\n[friction]\nslope_s_per_m = {slope}\n[pad]\nmass = [[1.0, 0.0], [0.0, 1.0]]\nstiffness = \
             [[1e6, 0.0], [0.0, 2e6]]\n[[contact]]\npad_normal = [0.0, 1.0]\npad_sliding = [1.0, 0.0]\nradius_m = 0.1\n\
             stiffness_n_per_m = {stiffness}\ndamping_n_s_per_m = {damping}\n{more}"
        ))
    }

    const TABLE: &str = "[temperature]\nreference_c = 20\ncontact_stiffness = [[20, 1.0], [120, 0.75], [320, 0.5]]\n\
                         contact_damping = [[-20, 0.5], [20, 1.0], [120, 2.0]]\nfriction_slope = [[20, 1], [120, 1.5]]\n";

    fn roots(rig: &Rig) -> Vec<u64> {
        let spectrum =
            Solver::new(rig.model.dimension()).solve(&rig.model, &rig.reference, Vectors::Right).expect("solved");
        spectrum.roots.iter().flat_map(|root| [root.lambda.re.to_bits(), root.lambda.im.to_bits()]).collect()
    }

    #[test]
    fn factors_are_linear_between_points_and_constant_beyond() {
        let points = [[20.0, 1.0], [120.0, 0.75], [320.0, 0.5]];
        for (at, factor) in [(-50.0, 1.0), (20.0, 1.0), (70.0, 0.875), (120.0, 0.75), (220.0, 0.625), (400.0, 0.5)] {
            assert_eq!(factor_at(&points, at), factor, "{at}");
        }
        assert_eq!(factor_at(&[], 70.0), 1.0);
    }

    /// Factors and numbers are powers of two or small integers times such, so the products are exact.
    #[test]
    fn a_rig_at_a_temperature_is_the_rig_with_the_numbers_multiplied() {
        let table = inline(4e6, 16.0, -0.5, TABLE).expect("read");
        for (at_c, stiffness, damping, slope) in
            [(20.0, 4e6, 16.0, -0.5), (120.0, 3e6, 32.0, -0.75), (70.0, 3.5e6, 24.0, -0.625), (500.0, 2e6, 32.0, -0.75)]
        {
            let at = table.at_temperature(at_c).expect("derived");
            let written = inline(stiffness, damping, slope, "").expect("read");
            assert_eq!(roots(&at), roots(&written), "{at_c}");
            assert_eq!(at.content_hash, table.content_hash);
            assert_eq!(at.temperature.as_ref().map(Temperature::present_c), Some(at_c));
            assert_eq!(at.notes(&at.reference).count(), usize::from(at_c > 120.0), "beyond two of the tables");
            assert_eq!(
                roots(&at.at_temperature(20.0).expect("back")),
                roots(&table),
                "of the file, not of the last one"
            );
        }
        assert_eq!(roots(&table), roots(&inline(4e6, 16.0, -0.5, "").expect("read")));
    }

    /// A law `p(δ)` becomes `p(f δ)`: at every pressure the tangent is `f` times as large, whatever the law.
    #[test]
    fn every_law_of_a_contact_state_is_stiffer_by_the_factor_at_every_force() {
        let base = include_str!("../../launch/rigs/rough-pad.toml");
        let state = base.find("[contact_state]").expect("there");
        let pairs = base.find("# Seven strips").expect("there");
        for (law, stiffness) in [
            ("law = \"linear\"", "stiffness_n_per_m = 1e7\n"),
            ("law = \"power\"\nexponent = 2.0\nreference_m = 1e-5\nroughness_m = 1e-6", "stiffness_n_per_m = 1e7\n"),
            ("law = \"exponential\"\npressure_pa = 1e4\nroughness_m = 2e-6\narea_m2 = 2e-4", ""),
            ("law = \"table\"\ntable = \"law.csv\"\narea_m2 = 2e-4", ""),
        ] {
            let text = format!(
                "{}[temperature]\nreference_c = 20\ncontact_stiffness = [[20, 1], [220, 0.5]]\n[contact_state]\n{law}\n\
                 measured = \"contact-force\"\nload_pad = [0.0, -1.0, 0.0]\n{}",
                &base[..state],
                base[pairs..].replace("[[contact]]\n", &format!("[[contact]]\n{stiffness}"))
            );
            let table = b"closure_m,pressure_pa\n-1e-5,1e3\n0,1e4\n1e-5,3e5\n1e-4,3e7\n".to_vec();
            let files = [("rig.toml", text.into_bytes()), ("law.csv", table)]
                .map(|(name, bytes)| RigFile { name: name.into(), bytes });
            let cold = Rig::from_files(&files).expect(law);
            let hot = cold.at_temperature(220.0).expect(law);
            let parts = |rig: &Rig| rig.model.statics().expect("a state").parts().clone();
            let (cold, hot) = (parts(&cold), parts(&hot));
            for force in [0.5, 7.0, 300.0] {
                let tangent = |parts: &crate::contact::StaticsParts| {
                    let closure = parts.law.closure_at(force / parts.area[0]);
                    (closure, parts.area[0] * parts.law.at(closure).tangent)
                };
                let ((cold_m, cold_k), (hot_m, hot_k)) = (tangent(&cold), tangent(&hot));
                assert!((hot_k / cold_k - 0.5).abs() < 1e-11, "{law} {force}: {hot_k} of {cold_k}");
                assert!((hot_m / cold_m - 2.0).abs() < 1e-11, "{law} {force}: {hot_m} of {cold_m}");
            }
        }
    }

    #[test]
    fn bad_tables_are_refused_with_their_place() {
        let refused = |table: &str| inline(4e6, 0.0, 0.0, table).map_err(|error| error.to_string()).unwrap_err();
        for (table, expected) in [
            (
                "[temperature]\nreference_c = 20\n",
                "rig.toml: `temperature` is missing; expected a table contact_stiffness",
            ),
            ("[temperature]\ncontact_stiffness = [[20, 1], [30, 1]]\n", "`reference_c` is missing"),
            (
                "[temperature]\nreference_c = -300\ncontact_stiffness = [[20, 1], [30, 1]]\n",
                "rig.toml: `temperature.reference_c` is -300, expected -273.15 to 3000 °C",
            ),
            (
                "[temperature]\nreference_c = 20\ncontact_stiffness = [[20, 1]]\n",
                "rig.toml: `temperature.contact_stiffness` is 1 points, expected at least 2",
            ),
            (
                "[temperature]\nreference_c = 20\ncontact_stiffness = [[20, 1], [20, 1]]\n",
                "rig.toml: `temperature.contact_stiffness[1][0]` is 20, expected more than 20 °C, the temperature before it",
            ),
            (
                "[temperature]\nreference_c = 20\ncontact_stiffness = [[20, 1], [30, 0]]\n",
                "rig.toml: `temperature.contact_stiffness[1][1]` is 0, expected more than 0",
            ),
            (
                "[temperature]\nreference_c = 20\ncontact_stiffness = [[20, 1], [30, nan]]\n",
                "rig.toml: `temperature.contact_stiffness[1][1]` is NaN, expected a finite number",
            ),
            (
                "[temperature]\nreference_c = 40\ncontact_stiffness = [[20, 1], [30, 1]]\n",
                "rig.toml: `temperature.contact_stiffness` is given from 20 to 30 °C, expected a range with reference_c = 40",
            ),
            (
                "[temperature]\nreference_c = 30\ncontact_stiffness = [[20, 1], [40, 0.5]]\n",
                "rig.toml: `temperature.contact_stiffness` is 0.75 at reference_c = 30, expected 1 there",
            ),
            (
                "[temperature]\nreference_c = 20\ncontact_damping = [[20, 1], [30, 1]]\n",
                "rig.toml: `temperature.contact_damping` has nothing to act on: damping_n_s_per_m of every contact pair is 0; \
              expected no such key",
            ),
            (
                "[temperature]\nreference_c = 20\nfriction_slope = [[20, 1], [30, 1]]\n",
                "rig.toml: `temperature.friction_slope` has nothing to act on: [friction] gives no slope; expected no such key",
            ),
        ] {
            assert!(refused(table).contains(expected), "{}\nnot\n{expected}", refused(table));
        }
        let rig = inline(4e6, 0.0, 0.0, "").expect("read");
        let none = rig.at_temperature(20.0).map_err(|error| error.to_string()).unwrap_err();
        assert!(none.contains("two: `temperature` is missing; expected the table [temperature]"), "{none}");
    }

    #[test]
    fn temperatures_out_of_range_are_refused() {
        let rig = inline(4e6, 16.0, -0.5, TABLE).expect("read");
        for (at_c, expected) in [(f64::NAN, "a finite number"), (-274.0, "-273.15 to 3000 °C"), (3001.0, "3000 °C")] {
            let refused = rig.at_temperature(at_c).map_err(|error| error.to_string()).unwrap_err();
            assert!(refused.contains("temperature_c") && refused.contains(expected), "{refused}");
        }
    }
}
