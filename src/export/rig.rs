//! Writes reduced models as rigs: archives of modal data with a hash in their names, and the rig file that refers to
//! them.

use std::io::Cursor;
use std::path::Path;

use faer::Mat;
use npyz::WriterBuilder;
use npyz::zip::DateTime;
use npyz::zip::write::FileOptions;
use sha2::{Digest, Sha256};

use super::error::ExportError;
use crate::full_model::{DampedModes, FullModelFile, PartGeometry};
use crate::physics::ResidualFlexibility;
use crate::reduction::{FullPart, Kept, PartMatrices, Residual};
use crate::rig::{Certificate, RigFile};
use crate::text::hex::hex;

/// Name of the rig in a rig file called `file`: the file name without its extension.
pub(super) fn rig_name(file: &str) -> String {
    Path::new(file).file_stem().map_or(file.into(), |stem| stem.to_string_lossy()).into_owned()
}

/// Number of hexadecimal digits of a hash in a file name.
pub const HASH_DIGITS: usize = 12;

/// Most negative `ω²` accepted as a rounded rigid-body motion, relative to the highest `ω²` kept.
const ROUNDING: f64 = 1e-6;

/// One side of a rig of kind 2.
#[derive(Clone, Debug)]
pub struct ModalSide<'a> {
    /// `pad` or `disc`.
    pub name: &'a str,
    /// Positions of the `c` interface nodes, m.
    pub nodes_m: Vec<[f64; 3]>,
    /// `ω` of the modes, rad/s, ascending.
    pub omega_rad_s: Vec<f64>,
    /// `Φ`, kg^-1/2, `3c` by modes; rows are x, y and z of each node.
    pub phi: Mat<f64>,
    /// Residual flexibility and inertia between x, y and z of the nodes.
    pub residual: Option<&'a Residual>,
    /// Damping ratio of each mode, or a single one of all modes.
    pub damping_ratio: Option<Vec<f64>>,
    /// This side's contribution to the unit mass matrix, if the columns of `phi` also move the other side.
    pub mass_share: Option<Mat<f64>>,
    /// Damping and rotation of this side.
    pub matrices: PartMatrices,
}

/// The sides of a rig, from the modes kept of pad and disc of a full model.
///
/// # Errors
/// [`ExportError::Indefinite`].
pub fn modal_sides<'a>(full: &'a FullModelFile, kept: &'a [Kept]) -> Result<Vec<ModalSide<'a>>, ExportError> {
    for (part, kept) in full.model.parts.iter().zip(kept) {
        let squares = &kept.modes.omega_squared;
        let limit = -ROUNDING * squares.iter().fold(0.0_f64, |largest, square| largest.max(square.abs()));
        if let Some(square) = squares.iter().find(|square| **square < limit) {
            let field = format!("{}.stiffness", part.name);
            let file = full.file_of(&field).to_string();
            return Err(ExportError::Indefinite { file, field, value: *square, limit });
        }
    }
    let side = |(index, ((part, geometry), kept)): (usize, ((&'a FullPart, &PartGeometry), &'a Kept))| {
        let (rows, phi) = (geometry.interface_rows(), kept.modes.phi.as_ref());
        ModalSide {
            name: &part.name,
            nodes_m: geometry.interface_m(),
            // Rounding may leave `ω²` of a rigid-body motion slightly negative.
            omega_rad_s: kept.modes.omega_squared.iter().map(|square| square.max(0.0).sqrt()).collect(),
            phi: Mat::from_fn(rows.len(), phi.ncols(), |i, mode| rows[i].map_or(0.0, |row| phi[(row, mode)])),
            residual: kept.residual.as_ref(),
            damping_ratio: match &geometry.damping_ratio {
                DampedModes::None => None,
                DampedModes::Every(ratio) => Some(vec![*ratio]),
                DampedModes::Lowest(ratios) => {
                    Some((0..phi.ncols()).map(|mode| ratios.get(mode).copied().unwrap_or(0.0)).collect())
                }
            },
            mass_share: None,
            matrices: full.model.matrices_of_part(index, phi),
        }
    };
    Ok(full.model.parts.iter().zip(&full.geometry).zip(kept).enumerate().map(side).collect())
}

/// Comment lines that name the full model a rig was reduced from.
pub fn source_remarks(full: &FullModelFile) -> Vec<String> {
    let file = full.path.file_name().unwrap_or_default().to_string_lossy();
    vec![
        format!(
            "Reduced by squealcast {} from {file}: {} degrees of freedom, SHA-256",
            env!("CARGO_PKG_VERSION"),
            full.model.dimension()
        ),
        full.content_hash.clone(),
    ]
}

impl ModalSide<'_> {
    /// The modal data as an archive that a rig of kind 2 reads.
    fn archive(&self) -> std::io::Result<Vec<u8>> {
        let (count, modes, phi) = (self.nodes_m.len(), self.omega_rad_s.len(), &self.phi);
        let mut arrays = vec![
            ("omega_rad_s", vec![modes], self.omega_rad_s.clone()),
            ("phi", vec![count, 3, modes], by_rows(phi)),
            ("nodes_m", vec![count, 3], self.nodes_m.iter().flatten().copied().collect()),
        ];
        if let Some(share) = &self.mass_share {
            arrays.push(("mass_share", vec![modes, modes], by_rows(share)));
        }
        let PartMatrices { damping, gyroscopic, spin } = &self.matrices;
        for (name, matrix) in [("damping", damping), ("gyroscopic", gyroscopic), ("spin", spin)] {
            arrays.extend(matrix.as_ref().map(|matrix| (name, vec![modes, modes], by_rows(matrix))));
        }
        if let Some(residual) = self.residual {
            let n = residual.flexibility.nrows();
            arrays.push(("residual_flexibility", vec![n, n], by_rows(&residual.flexibility)));
            arrays.push(("residual_inertia", vec![n, n], by_rows(&residual.inertia)));
        }
        packed(&arrays)
    }
}

/// Residual flexibility between contact pairs as an archive that a rig of kind 2 reads.
fn residual_archive(residual: &ResidualFlexibility) -> std::io::Result<Vec<u8>> {
    let (c, lower) = (residual.normal.nrows(), lower_triangle);
    let mut arrays = vec![
        ("flexibility_normal", vec![c * (c + 1) / 2], lower(&residual.normal)),
        ("flexibility_sliding", vec![c, c], by_rows(&residual.sliding)),
    ];
    if let Some([normal, sliding]) = &residual.inertia {
        arrays.push(("inertia_normal", vec![c * (c + 1) / 2], lower(normal)));
        arrays.push(("inertia_sliding", vec![c, c], by_rows(sliding)));
    }
    packed(&arrays)
}

/// The lower triangle of a symmetric matrix, by rows.
pub(super) fn lower_triangle(matrix: &Mat<f64>) -> Vec<f64> {
    (0..matrix.nrows()).flat_map(|i| (0..=i).map(move |j| matrix[(i, j)])).collect()
}

pub(super) fn by_rows(matrix: &Mat<f64>) -> Vec<f64> {
    (0..matrix.nrows()).flat_map(|i| (0..matrix.ncols()).map(move |j| matrix[(i, j)])).collect()
}

/// An `.npz` archive of arrays, as `numpy.savez` would write it; `arrays` are names, shapes and values in C order.
pub(super) fn packed(arrays: &[(&str, Vec<usize>, Vec<f64>)]) -> std::io::Result<Vec<u8>> {
    let mut bytes = Cursor::new(vec![]);
    let mut archive = npyz::npz::NpzWriter::new(&mut bytes);
    for (name, shape, values) in arrays {
        let shape: Vec<u64> = shape.iter().map(|&length| length as u64).collect();
        // A fixed time stamp: equal modes must give equal archives.
        let options = FileOptions::default().last_modified_time(DateTime::default());
        let array = archive.array(name, options).map_err(std::io::Error::other)?;
        let mut writer = array.default_dtype().shape(&shape).begin_nd()?;
        writer.extend(values.iter().copied())?;
        writer.finish()?;
    }
    drop(archive);
    Ok(bytes.into_inner())
}

/// The files of a rig of kind 2: the rig file, called `file`, followed by the archives it refers to.
///
/// The name of the rig is that of its file. `remarks` are comment lines at the top; `common` are the tables that full
/// models and rigs share. `patches` is `contact_patch` with nodes numbered as in `sides`. `reduction` is the
/// certificate, if the rig has been compared. `residual` is residual flexibility between pairs, if the sides do not
/// have it themselves.
///
/// # Errors
/// [`ExportError`]: `Toml`, `Bytes`.
pub fn modal_rig(
    file: &str,
    remarks: &[String],
    common: &toml::Table,
    patches: Option<&toml::Value>,
    reduction: Option<&Certificate>,
    sides: &[ModalSide<'_>],
    residual: Option<&ResidualFlexibility>,
) -> Result<Vec<RigFile>, ExportError> {
    let stem = rig_name(file);
    let mut table = toml::Table::new();
    table.insert("name".to_owned(), stem.as_str().into());
    table.extend(common.clone());
    let mut archives = vec![];
    let mut add = |what: &str, bytes: Vec<u8>| -> toml::Value {
        let hash = hex(&Sha256::digest(&bytes));
        let name = format!("{stem}-{what}-{}.npz", &hash[..HASH_DIGITS]);
        archives.push(RigFile { name: name.clone(), bytes });
        name.into()
    };
    for side in sides {
        let bytes = side
            .archive()
            .map_err(|source| ExportError::Bytes { what: format!("archive of the modes of {}", side.name), source })?;
        let mut keys = toml::Table::new();
        keys.insert("modal".to_owned(), add(side.name, bytes));
        match side.damping_ratio.as_deref() {
            None => {}
            Some([ratio]) => drop(keys.insert("damping_ratio".to_owned(), (*ratio).into())),
            Some(ratios) => drop(keys.insert("damping_ratio".to_owned(), ratios.to_vec().into())),
        }
        table.insert(side.name.to_owned(), keys.into());
    }
    if let Some(residual) = residual {
        let bytes = residual_archive(residual)
            .map_err(|source| ExportError::Bytes { what: "archive of the residual flexibility".to_owned(), source })?;
        let mut keys = toml::Table::new();
        keys.insert("pairs".to_owned(), add("residual", bytes));
        table.insert("residual".to_owned(), keys.into());
    }
    table.extend(patches.map(|patches| ("contact_patch".to_owned(), patches.clone())));
    if let Some(reduction) = reduction {
        let known =
            toml::Value::try_from(reduction).map_err(|source| ExportError::Toml { what: "the certificate", source })?;
        table.insert("reduction".to_owned(), known);
    }
    let mut text: String = remarks.iter().map(|line| format!("# {line}\n")).collect();
    text += &toml::to_string(&table).map_err(|source| ExportError::Toml { what: "the rig", source })?;
    let mut files = vec![RigFile { name: file.to_owned(), bytes: text.into_bytes() }];
    files.extend(archives);
    Ok(files)
}
