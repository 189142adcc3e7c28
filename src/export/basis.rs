//! Writes a full model on a parametric basis as a rig: pad and disc on shared coordinates, or a system of small
//! matrices.

use faer::Mat;
use sha2::{Digest, Sha256};

use super::error::ExportError;
use super::matrix_market::write_array;
use super::rig::{HASH_DIGITS, ModalSide, modal_rig, rig_name, source_remarks};
use super::state::state_on_basis;
use crate::full_model::FullModelFile;
use crate::physics::{Law, Term};
use crate::reduction::{ParametricBasis, ParametricRequest, project_sparse};
use crate::rig::{Certificate, RigFile};
use crate::text::hex::hex;

/// The files of a rig on `basis`: the rig file, called `file`, followed by the files it refers to. `known` is the
/// certificate, if the rig has been compared.
///
/// # Errors
/// [`ExportError`]: `Toml`, `Bytes`, `Law`.
pub fn basis_rig(
    file: &str,
    full: &FullModelFile,
    request: &ParametricRequest,
    basis: &ParametricBasis,
    known: Option<&Certificate>,
) -> Result<Vec<RigFile>, ExportError> {
    let remarks = remarks(full, request, basis);
    let mut common = within(&full.common_tables, request);
    let mut record = record(full, request, basis);
    if full.geometry.is_empty() {
        common.insert("basis".to_owned(), record.into());
        if let Some(known) = known {
            let known =
                toml::Value::try_from(known).map_err(|source| ExportError::Toml { what: "the certificate", source })?;
            common.insert("reduction".to_owned(), known);
        }
        return system_rig(file, basis, &remarks, &common);
    }
    record.insert("shared".to_owned(), true.into());
    common.insert("basis".to_owned(), record.into());
    let projected = &basis.projected;
    let sides: Vec<ModalSide<'_>> = full
        .model
        .parts
        .iter()
        .zip(full.model.offsets())
        .zip(&full.geometry)
        .enumerate()
        .map(|(index, ((part, offset), geometry))| {
            let rows = geometry.interface_rows();
            let of_part = projected.basis.subrows(offset, part.mass.nrows());
            ModalSide {
                name: &part.name,
                nodes_m: geometry.interface_m(),
                // Rounding may leave `ω²` of a rigid-body motion slightly negative.
                omega_rad_s: projected.omega_squared.iter().map(|square| square.max(0.0).sqrt()).collect(),
                phi: Mat::from_fn(rows.len(), projected.omega_squared.len(), |i, k| {
                    rows[i].map_or(0.0, |row| projected.basis[(offset + row, k)])
                }),
                residual: None,
                damping_ratio: None,
                mass_share: (part.name == "pad").then(|| project_sparse(&part.mass, of_part, true)),
                matrices: {
                    let mut matrices = full.model.matrices_of_part(index, of_part);
                    let of_modes = full.model.modal_damping_of_part(index, of_part);
                    matrices.damping = [matrices.damping, of_modes].into_iter().flatten().reduce(|a, b| a + b);
                    matrices
                },
            }
        })
        .collect();
    let state = state_on_basis(file, full)?;
    common.extend(state.iter().map(|state| ("contact_state".to_owned(), state.table.clone().into())));
    let mut files = modal_rig(file, &remarks, &common, full.contact_patches.as_ref(), known, &sides, None)?;
    files.extend(state.into_iter().flat_map(|state| state.files));
    Ok(files)
}

/// The common tables of the full model, with the ranges of `[search]` and `[chart]` replaced by those of the basis.
fn within(common: &toml::Table, request: &ParametricRequest) -> toml::Table {
    let mut tables = common.clone();
    let mut set = |table: &str, key: &str, value: toml::Value| {
        let table = tables.entry(table.to_owned()).or_insert_with(|| toml::Table::new().into());
        if let Some(table) = table.as_table_mut() {
            table.insert(key.to_owned(), value);
        }
    };
    let range = request.range;
    if range.friction_coefficient[1] > 0.0 {
        set("search", "mu_max", range.friction_coefficient[1].into());
    }
    for (key, [low, high]) in [("normal_load_n", range.normal_load_n), ("disc_speed_rad_s", range.disc_speed_rad_s)] {
        // A chart needs a range of positive numbers with an interior.
        if 0.0 < low && low < high {
            set("chart", key, vec![low, high].into());
        }
    }
    tables
}

/// A rig with `[system]`: dense matrices in array format, and a unit mass matrix.
fn system_rig(
    file: &str,
    basis: &ParametricBasis,
    remarks: &[String],
    common: &toml::Table,
) -> Result<Vec<RigFile>, ExportError> {
    let stem = rig_name(file);
    let mut files = vec![];
    let mut write = |what: &str, matrix: &Mat<f64>| -> Result<toml::Value, ExportError> {
        let mut bytes = vec![];
        write_array(matrix, &format!("{what} of {stem} on its basis"), &mut bytes)
            .map_err(|source| ExportError::Bytes { what: what.to_owned(), source })?;
        let hash = hex(&Sha256::digest(&bytes));
        let name = format!("{stem}-{what}-{}.mtx", &hash[..HASH_DIGITS]);
        files.push(RigFile { name: name.clone(), bytes });
        Ok(name.into())
    };
    let projected = &basis.projected;
    let k = projected.omega_squared.len();
    let diagonal = |value: &dyn Fn(usize) -> f64| Mat::from_fn(k, k, |i, j| if i == j { value(i) } else { 0.0 });
    let mut system = toml::Table::new();
    system.insert("mass".to_owned(), write("mass", &diagonal(&|_| 1.0))?);
    let free = Term { matrix: diagonal(&|i| projected.omega_squared[i]), law: Law::Constant };
    let stiffness: Vec<&Term> = std::iter::once(&free).chain(&projected.stiffness).collect();
    for (key, terms) in [("stiffness", stiffness), ("damping", projected.damping.iter().collect())] {
        let mut list = vec![];
        for (index, term) in terms.into_iter().enumerate().filter(|(_, term)| term.matrix.norm_max() != 0.0) {
            let mut keys = toml::Table::new();
            keys.insert("matrix".to_owned(), write(&format!("{key}-{index}"), &term.matrix)?);
            match &term.law {
                Law::Constant => {}
                Law::Custom(law) => {
                    keys.insert("scale".to_owned(), law.text.as_str().into());
                }
                Law::DiscSpeed { power } => {
                    keys.insert("scale".to_owned(), format!("disc_speed_rad_s^{power}").into());
                }
                law @ (Law::ContactStiffness
                | Law::FrictionStiffness
                | Law::ContactDamping
                | Law::FrictionDamping
                | Law::FrictionSlope
                | Law::FallingFriction { .. }
                | Law::LateralFriction
                | Law::FrictionChebyshev { .. }
                | Law::DiscSpeedInContact { .. }
                | Law::DiscSpeedChebyshev { .. }) => {
                    return Err(ExportError::Law { key, index, law: format!("{law:?}") });
                }
            }
            list.push(toml::Value::from(keys));
        }
        if !list.is_empty() {
            system.insert(key.to_owned(), list.into());
        }
    }
    let mut table = toml::Table::new();
    table.insert("name".to_owned(), stem.as_str().into());
    table.extend(common.clone());
    table.insert("system".to_owned(), system.into());
    let mut text: String = remarks.iter().map(|line| format!("# {line}\n")).collect();
    text += &toml::to_string(&table).map_err(|source| ExportError::Toml { what: "the rig", source })?;
    files.insert(0, RigFile { name: file.to_owned(), bytes: text.into_bytes() });
    Ok(files)
}

/// The table `[basis]`: the range of conditions, the tolerance and the largest error at held-out points.
fn record(full: &FullModelFile, request: &ParametricRequest, basis: &ParametricBasis) -> toml::Table {
    let range = |[low, high]: [f64; 2]| toml::Value::from(vec![low, high]);
    let mut table = toml::Table::new();
    table.insert("degrees_of_freedom".to_owned(), (full.model.dimension() as i64).into());
    table.insert("friction_coefficient".to_owned(), range(request.range.friction_coefficient));
    table.insert("normal_load_n".to_owned(), range(request.range.normal_load_n));
    table.insert("disc_speed_rad_s".to_owned(), range(request.range.disc_speed_rad_s));
    table.insert("growth_floor_per_s".to_owned(), request.counted.growth_floor_per_s.into());
    table.insert("tolerance".to_owned(), request.tolerance.into());
    table.insert("held_out".to_owned(), (basis.held_out.len() as i64).into());
    table.insert("largest_error".to_owned(), basis.worst().into());
    table
}

/// Comment lines at the top of the rig file: the full model and the basis.
fn remarks(full: &FullModelFile, request: &ParametricRequest, basis: &ParametricBasis) -> Vec<String> {
    let mut lines = source_remarks(full);
    lines.push(format!(
        "{} vectors, of right and left vectors of the full model at {} operating points; tolerance {:e}, held out:",
        basis.projected.omega_squared.len(),
        basis.sampled.len(),
        request.tolerance
    ));
    lines.extend(basis.held_out.iter().map(|held| {
        format!(
            "  {} N, {} rad/s, friction coefficient {}: {} roots, largest |dlambda|/|lambda| {:.1e}",
            held.point.normal_load_n,
            held.point.disc_speed_rad_s,
            held.point.friction_coefficient,
            held.comparison.errors.len(),
            held.comparison.worst()
        )
    }));
    lines
}
