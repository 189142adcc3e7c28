//! Kind 3: sums of matrices, each times a scale that depends on the operating point.

use faer::Mat;

use super::raw::{RawSystem, RawTerm};
use super::settings::{MOST_COORDINATES, MOST_TERMS, Settings, at_most};
use super::source::Source;
use super::{Built, RigError, matrix_market, scale};
use crate::physics::{ContactState, Law, Model, OperatingPoint, Term};
use crate::reduction::{
    ReductionError, SparseMatrix, is_symmetric, lowest_modes, project_sparse, weighted_sum, whiten,
};

/// A term as it was read, before projection.
struct ReadTerm {
    matrix: SparseMatrix,
    symmetric: bool,
    law: Law,
    at_reference: f64,
    description: String,
}

/// Transforms the matrix of a term to the coordinates of the model.
type Reduce = Box<dyn Fn(&ReadTerm) -> Mat<f64>>;

/// Builds the model of a rig of kind 3.
///
/// Without `modes`, the coordinates are `y = Lᵀ x` with `M = L Lᵀ`, and nothing is truncated. With `modes = k`, they
/// are the `k` lowest real modes of `M` and the symmetric stiffness terms at the reference point.
///
/// # Errors
/// [`RigError`].
pub(super) fn build(source: &mut Source<'_>, raw: &RawSystem, settings: &Settings) -> Result<Built, RigError> {
    let file = source.rig_file.clone();
    if raw.stiffness.is_empty() {
        let (field, limit) = ("system.stiffness".to_owned(), "at least one [[system.stiffness]]".to_owned());
        return Err(RigError::MissingKey { file, field, limit });
    }
    check_terms(&file, raw)?;
    at_most(&file, "system.modes", raw.modes.unwrap_or(0), MOST_COORDINATES)?;
    let listed = matrix_market::read(&raw.mass, source.read("system.mass", &raw.mass)?)?;
    let n = listed.rows;
    if listed.columns != n || n == 0 {
        let value = format!("{n}x{} ({})", listed.columns, raw.mass);
        let limit = "a square matrix with at least one row".to_owned();
        return Err(RigError::Shape { file, field: "system.mass".to_owned(), value, limit });
    }
    // Checked before memory for n columns is allocated: a positive definite mass matrix has an entry in every column.
    if listed.entries.len() < n {
        let value = format!("{n}x{n} with {} entries ({})", listed.entries.len(), raw.mass);
        let limit = "an entry on every place of the diagonal".to_owned();
        return Err(RigError::Shape { file, field: "system.mass".to_owned(), value, limit });
    }
    let mass = listed.to_sparse(&raw.mass)?;

    let stiffness = read_terms(source, "stiffness", &raw.stiffness, n, &settings.reference)?;
    let damping = read_terms(source, "damping", &raw.damping, n, &settings.reference)?;
    let in_mass_file = |source| RigError::Reduction {
        file: match &source {
            ReductionError::Indefinite { .. } | ReductionError::Unsymmetric { .. } => format!("{file} ({})", raw.mass),
            _ => file.clone(),
        },
        source,
    };

    let (dimension, reduce): (usize, Reduce) = match raw.modes {
        Some(count) => {
            let symmetric: Vec<(f64, &SparseMatrix)> =
                stiffness.iter().filter(|term| term.symmetric).map(|term| (term.at_reference, &term.matrix)).collect();
            if symmetric.is_empty() {
                let value = "selects modes of a system without a symmetric stiffness term".to_owned();
                let limit = "a symmetric matrix among [[system.stiffness]], or no `modes`".to_owned();
                return Err(RigError::Kind { file, field: "system.modes".to_owned(), value, limit });
            }
            let phi = weighted_sum(n, &symmetric)
                .and_then(|sum| lowest_modes("system", &mass, &sum, count))
                .map_err(in_mass_file)?
                .phi;
            (count, Box::new(move |term| project_sparse(&term.matrix, phi.as_ref(), term.symmetric)))
        }
        None => {
            if n > MOST_COORDINATES {
                let value = format!("not given for {n} degrees of freedom");
                let limit = format!("modes = k above {MOST_COORDINATES} degrees of freedom");
                return Err(RigError::Range { file, field: "system.modes".to_owned(), value, limit });
            }
            let whitening = whiten("system.mass", mass.to_dense().as_ref()).map_err(in_mass_file)?;
            (n, Box::new(move |term| whitening.congruence(term.matrix.to_dense().as_ref(), term.symmetric)))
        }
    };
    let build = |terms: &[ReadTerm]| -> Vec<Term> {
        terms.iter().map(|term| Term { matrix: reduce(term), law: term.law.clone() }).collect()
    };
    let model = Model::new(dimension, build(&stiffness), build(&damping), settings.contact_law, None)
        .map_err(|source| RigError::Model { file: file.clone(), source })?;

    let mut contents = vec!["kind       system of matrices (kind 3)".to_owned()];
    contents.push(match raw.modes {
        Some(count) => {
            format!("modes      {count} lowest of {n} degrees of freedom, symmetric stiffness at the reference")
        }
        None => format!("modes      all of {n} degrees of freedom"),
    });
    contents.extend(stiffness.iter().map(|term| format!("stiffness  {}", term.description)));
    contents.extend(damping.iter().map(|term| format!("damping    {}", term.description)));
    Ok(Built { model, contact: None, contents, shapes: vec![], band_max_hz: settings.band_max_hz })
}

/// Checks that a system has at most [`MOST_TERMS`] terms of each sort.
///
/// # Errors
/// [`RigError::Range`].
pub(crate) fn check_terms(file: &str, raw: &RawSystem) -> Result<(), RigError> {
    at_most(file, "system.stiffness", raw.stiffness.len(), MOST_TERMS)?;
    at_most(file, "system.damping", raw.damping.len(), MOST_TERMS)
}

/// Reads the terms of `[[system.stiffness]]` or `[[system.damping]]`.
fn read_terms(
    source: &mut Source<'_>,
    key: &str,
    raw: &[RawTerm],
    n: usize,
    reference: &OperatingPoint,
) -> Result<Vec<ReadTerm>, RigError> {
    let file = source.rig_file.clone();
    let mut terms = vec![];
    for (index, raw) in raw.iter().enumerate() {
        let field = |name: &str| format!("system.{key}[{index}].{name}");
        let (law, at_reference) = checked_law(&file, &field("scale"), &raw.scale, reference)?;
        let listed = matrix_market::read(&raw.matrix, source.read(&field("matrix"), &raw.matrix)?)?;
        if (listed.rows, listed.columns) != (n, n) {
            let value = format!("{}x{} ({})", listed.rows, listed.columns, raw.matrix);
            let limit = format!("{n}x{n}, as system.mass");
            return Err(RigError::Shape { file, field: field("matrix"), value, limit });
        }
        let matrix = listed.to_sparse(&raw.matrix)?;
        let symmetric = is_symmetric(&matrix);
        let description = format!(
            "{} times {}, {}, {} entries",
            raw.matrix,
            raw.scale,
            if symmetric { "symmetric" } else { "unsymmetric" },
            matrix.compute_nnz()
        );
        terms.push(ReadTerm { matrix, symmetric, law, at_reference, description });
    }
    Ok(terms)
}

/// Parses a scale into a law and evaluates it at the reference point.
///
/// # Errors
/// [`RigError::Scale`], also if the value is not finite.
pub(crate) fn checked_law(
    file: &str,
    field: &str,
    text: &str,
    reference: &OperatingPoint,
) -> Result<(Law, f64), RigError> {
    let refuse = |reason, limit| {
        let (file, field, value) = (file.to_owned(), field.to_owned(), text.to_owned());
        RigError::Scale { file, field, value, reason, limit }
    };
    let law = scale::parse(text).map_err(|error| refuse(error.reason, error.limit))?;
    let at_reference = value_at(&law, reference);
    if at_reference.is_finite() {
        return Ok((law, at_reference));
    }
    let reason = format!(
        "is {at_reference} at the reference point ({} N, {} rad/s, friction coefficient {})",
        reference.normal_load_n, reference.disc_speed_rad_s, reference.friction_coefficient
    );
    Err(refuse(reason, "a finite number".to_owned()))
}

/// The value of a law at the reference point, with the friction coefficient that the model would pass to it.
fn value_at(law: &Law, reference: &OperatingPoint) -> f64 {
    match law {
        Law::Custom(custom) => {
            // The contact of a system never opens, but it may not slide.
            let mu = match reference.state_closed() {
                ContactState::Sliding => reference.friction_coefficient,
                ContactState::NotSliding | ContactState::Open => 0.0,
            };
            (custom.evaluate)(&reference.with_friction(mu))
        }
        // The terms of a system have scales or none. These laws belong to contact pairs and projected full models.
        Law::Constant
        | Law::ContactStiffness
        | Law::FrictionStiffness
        | Law::ContactDamping
        | Law::FrictionDamping
        | Law::FrictionSlope
        | Law::FallingFriction { .. }
        | Law::LateralFriction
        | Law::FrictionChebyshev { .. }
        | Law::DiscSpeed { .. }
        | Law::DiscSpeedInContact { .. }
        | Law::DiscSpeedChebyshev { .. } => 1.0,
    }
}
