//! Reduced models to rig files: modal data as archives under names with their hash, then the rig file that names them.

use std::io::Cursor;
use std::path::Path;

use anyhow::Context;
use faer::Mat;
use npyz::WriterBuilder;
use npyz::zip::DateTime;
use npyz::zip::write::FileOptions;
use sha2::{Digest, Sha256};

use crate::certificate::Certificate;
use crate::reduction::{Kept, Residual};
use crate::rig::RigFile;

/// Digits of a hash that a name carries.
pub(super) const HASH_DIGITS: usize = 12;

/// One side of a rig of kind 2.
#[derive(Clone, Debug)]
pub struct ModalSide<'a> {
    /// `pad` or `disc`.
    pub name: &'a str,
    /// Positions of the `c` interface nodes, m.
    pub nodes_m: Vec<[f64; 3]>,
    /// `ω`, rad/s, ascending.
    pub omega_rad_s: Vec<f64>,
    /// `Φ`, `3c` by modes, kg^-1/2; x, y and z of every node.
    pub phi: Mat<f64>,
    /// Between x, y and z of every node.
    pub residual: Option<&'a Residual>,
    /// Of every mode.
    pub damping_ratio: Option<f64>,
    /// This side's part of the unit mass matrix, where the columns of `phi` move the other side too.
    pub mass_share: Option<Mat<f64>>,
}

impl<'a> ModalSide<'a> {
    /// What was kept of a substructure, `rows` being those of x, y and z of every interface node.
    pub fn new(
        name: &'a str,
        kept: &'a Kept,
        nodes_m: Vec<[f64; 3]>,
        rows: &[Option<usize>],
        damping_ratio: Option<f64>,
    ) -> Self {
        let phi = kept.modes.phi.as_ref();
        Self {
            name,
            nodes_m,
            // A rigid-body motion is found a rounding above or below zero.
            omega_rad_s: kept.modes.omega_squared.iter().map(|square| square.max(0.0).sqrt()).collect(),
            phi: Mat::from_fn(rows.len(), phi.ncols(), |i, mode| rows[i].map_or(0.0, |row| phi[(row, mode)])),
            residual: kept.residual.as_ref(),
            damping_ratio,
            mass_share: None,
        }
    }

    /// The arrays that a rig of kind 2 reads, as `numpy.savez` would write them.
    fn archive(&self) -> std::io::Result<Vec<u8>> {
        let mut bytes = Cursor::new(vec![]);
        let mut archive = npyz::npz::NpzWriter::new(&mut bytes);
        let mut write = |name: &str, shape: &[usize], values: &mut dyn Iterator<Item = f64>| -> std::io::Result<()> {
            let shape: Vec<u64> = shape.iter().map(|&length| length as u64).collect();
            // The time of writing would make the same modes another archive.
            let options = FileOptions::default().last_modified_time(DateTime::default());
            let array = archive.array(name, options).map_err(std::io::Error::other)?;
            let mut writer = array.default_dtype().shape(&shape).begin_nd()?;
            writer.extend(values)?;
            writer.finish()
        };
        let (count, modes) = (self.nodes_m.len(), self.omega_rad_s.len());
        write("omega_rad_s", &[modes], &mut self.omega_rad_s.iter().copied())?;
        let phi = &self.phi;
        let rows = (0..3 * count).flat_map(|row| (0..modes).map(move |mode| phi[(row, mode)]));
        write("phi", &[count, 3, modes], &mut { rows })?;
        write("nodes_m", &[count, 3], &mut self.nodes_m.iter().flatten().copied())?;
        if let Some(share) = &self.mass_share {
            let entries = (0..modes).flat_map(|row| (0..modes).map(move |column| share[(row, column)]));
            write("mass_share", &[modes, modes], &mut { entries })?;
        }
        if let Some(residual) = self.residual {
            let matrices = [("residual_flexibility", &residual.flexibility), ("residual_inertia", &residual.inertia)];
            for (name, matrix) in matrices {
                let n = matrix.nrows();
                let entries = (0..n).flat_map(|row| (0..n).map(move |column| matrix[(row, column)]));
                write(name, &[n, n], &mut { entries })?;
            }
        }
        drop(archive);
        Ok(bytes.into_inner())
    }
}

/// The files of a rig of kind 2: the rig file, called `file`, first, then the archives it names.
///
/// `common` are the tables that full models and rigs share; `patches` is `contact_patch` with nodes counted as in the
/// sides; `reduction`, where it is known, is how far the rig is from its full model; `remarks` are lines of comment at the
/// top.
///
/// # Errors
/// What could not be put into words of TOML or into an archive.
pub fn modal_rig(
    file: &str,
    name: &str,
    remarks: &[String],
    common: &toml::Table,
    patches: &toml::Value,
    reduction: Option<&Certificate>,
    sides: &[ModalSide<'_>],
) -> anyhow::Result<Vec<RigFile>> {
    let stem = Path::new(file).file_stem().map_or(file.into(), |stem| stem.to_string_lossy());
    let mut table = toml::Table::new();
    table.insert("name".to_owned(), name.into());
    table.extend(common.clone());
    let mut archives = vec![];
    for side in sides {
        let bytes = side.archive().with_context(|| format!("{}: its modes cannot be packed", side.name))?;
        let hash: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        let archive = format!("{stem}-{}-{}.npz", side.name, &hash[..HASH_DIGITS]);
        let mut keys = toml::Table::new();
        keys.insert("modal".to_owned(), archive.as_str().into());
        if let Some(ratio) = side.damping_ratio {
            keys.insert("damping_ratio".to_owned(), ratio.into());
        }
        table.insert(side.name.to_owned(), keys.into());
        archives.push(RigFile { name: archive, bytes });
    }
    table.insert("contact_patch".to_owned(), patches.clone());
    if let Some(reduction) = reduction {
        let known = toml::Value::try_from(reduction).context("the comparison cannot be put into words of TOML")?;
        table.insert("reduction".to_owned(), known);
    }
    let mut text: String = remarks.iter().map(|line| format!("# {line}\n")).collect();
    text += &toml::to_string(&table).context("the rig cannot be put into words of TOML")?;
    let mut files = vec![RigFile { name: file.to_owned(), bytes: text.into_bytes() }];
    files.extend(archives);
    Ok(files)
}
