//! Full models from files: the matrices of a finite-element program, before reduction.
//!
//! A full model is a TOML file with the common tables of a rig file and either `[pad]`, `[disc]` and
//! `[[contact_patch]]` (`part`), or `[system]` as in rig files of kind 3. Matrices are read line by line into 16 bytes
//! per listed entry (`entries`). The contents of the files are not kept, only their hashes (`files`).

mod coordinates;
mod entries;
mod files;
mod part;
mod raw;
pub mod slepc;
mod state;
mod tables;
pub mod verification;

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use crate::files::input_file;
use crate::physics::{ContactLaw, ModelError};
use crate::reduction::{
    Analysed, Engine, FullContact, FullModel, FullPart, Kept, PartTurning, Progress, ReductionError, SparseMatrix,
    SparseRow, SparseTerm, Substructure, Wanted, keep_modes,
};
use crate::rig::raw::{Common, RawPatch, RawSystem, RawTerm};
use crate::rig::settings::Settings;
use crate::rig::{Pair, RigError, patch, settings, system};

use files::Files;
use raw::{RawFullModel, RawPart};
pub use state::FullState;
use verification::DEFAULT_BAND_HZ;

/// A full model and everything its files contain.
#[derive(Clone, Debug)]
pub struct FullModelFile {
    /// Name of the full model.
    pub name: String,
    /// Equation of motion.
    pub model: FullModel,
    /// Nodes and rows of pad and disc; the disc is absent if rigid, both are absent for a system.
    pub geometry: Vec<PartGeometry>,
    /// Contact pairs, in the order of the rows of `model.contact`. Their nodes are indices into `geometry[..].nodes_m`.
    pub pairs: Vec<Pair>,
    /// The common tables, checked.
    pub settings: Settings,
    /// The common tables as written in the file.
    pub common_tables: toml::Table,
    /// `[[contact_patch]]` as written in the file; `None` for a system.
    pub contact_patches: Option<toml::Value>,
    /// `[contact_state]`; `None` if the contact pairs are always closed.
    pub state: Option<FullState>,
    /// Field, such as `pad.mass`, and file name of each matrix of a part.
    matrix_files: Vec<(String, String)>,
    /// Path of the TOML file.
    pub path: PathBuf,
    /// SHA-256 of the TOML file and all files it refers to, hexadecimal.
    pub content_hash: String,
    /// Description of the contents, one line each, for [`FullModelFile::describe`].
    pub contents: Vec<String>,
}

/// Marks a row that belongs to no node: an internal degree of freedom of an element.
pub const INTERNAL: usize = usize::MAX;

/// Nodes and rows of a part.
#[derive(Clone, Debug)]
pub struct PartGeometry {
    /// Positions of all nodes, m.
    pub nodes_m: Vec<[f64; 3]>,
    /// Node index (or [`INTERNAL`]) and direction of each row: 0 to 2 are displacements along x, y, z; 3 to 5 rotations
    /// about them.
    pub rows: Vec<(usize, usize)>,
    /// Node indices of the contact interface, in the order listed.
    pub interface: Vec<usize>,
    /// Damping ratios of modes of the part.
    pub damping_ratio: DampedModes,
}

/// Damping ratios of modes of a part.
#[derive(Clone, Debug, PartialEq)]
pub enum DampedModes {
    None,
    /// The same ratio for every mode.
    Every(f64),
    /// A ratio for each of the lowest modes.
    Lowest(Vec<f64>),
}

/// Upper end of the modes that a single damping ratio is of, relative to the band.
pub const DAMPED_BAND: f64 = 2.5;

impl FullModelFile {
    /// Whether the TOML file at `path` is a full model, which its parts show: they refer to matrix files. A file with
    /// `[system]` is not recognised, since it may also be a rig.
    pub fn is_one(path: &Path) -> bool {
        let table =
            input_file::read_text(path, input_file::TOML).ok().and_then(|text| text.parse::<toml::Table>().ok());
        let has = |part: &str| {
            let part = table.as_ref().and_then(|table| table.get(part)).and_then(toml::Value::as_table);
            part.is_some_and(|part| {
                part.contains_key("interface_nodes") || part.get("mass").is_some_and(|m| m.is_str())
            })
        };
        has("pad") || has("disc")
    }

    /// Loads the full model whose TOML file is at `path`.
    ///
    /// # Errors
    /// [`RigError`], naming file, field or line, value and limit.
    pub fn load(path: &Path) -> Result<Self, RigError> {
        Self::load_as(path, &Self::toml(path)?)
    }

    /// The content of the TOML file at `path`.
    ///
    /// # Errors
    /// [`RigError::NoSuchFile`].
    pub fn toml(path: &Path) -> Result<Vec<u8>, RigError> {
        input_file::read(path, input_file::TOML).map_err(|error| RigError::NoSuchFile {
            value: path.display().to_string(),
            reason: error.to_string(),
            limit: "the TOML file of a full model".to_owned(),
        })
    }

    /// Loads the full model as if the TOML file at `path` had this content.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_as(path: &Path, toml: &[u8]) -> Result<Self, RigError> {
        let mut files = Files::new(path, toml);
        let own: RawFullModel = crate::rig::raw::parse(&files.toml, toml)?;
        let mut common_tables: toml::Table = crate::rig::raw::parse(&files.toml, toml)?;
        let contact_patches = common_tables.remove("contact_patch");
        let state_keys = common_tables.remove("contact_state").and_then(|table| table.as_table().cloned());
        common_tables.retain(|key, _| Common::TABLES.contains(&key));
        let settings = settings::check(&files.toml, &own.common())?;
        let toml = files.toml.clone();
        let refuse_beside_system = |field: &str| RigError::Kind {
            file: toml.clone(),
            field: field.to_owned(),
            value: "cannot be combined with [system]".to_owned(),
            limit: "either [system] or [pad] with its contact".to_owned(),
        };
        let missing = |field: &str, limit: &str| RigError::MissingKey {
            file: toml.clone(),
            field: field.to_owned(),
            limit: limit.to_owned(),
        };
        let read = match (&own.system, &own.pad) {
            (Some(_), Some(_)) => return Err(refuse_beside_system("pad")),
            (Some(_), None) if own.disc.is_some() => return Err(refuse_beside_system("disc")),
            (Some(_), None) if own.contact_patch.is_some() => return Err(refuse_beside_system("contact_patch")),
            (Some(_), None) if own.contact_state.is_some() => return Err(refuse_beside_system("contact_state")),
            (Some(system), None) => read_system(&mut files, system, &settings)?,
            (None, None) => return Err(missing("pad", "[pad] with stiffness and mass, or [system]")),
            (None, Some(pad)) => match own.contact_patch.as_deref() {
                None | Some([]) => return Err(missing("contact_patch", "at least one [[contact_patch]]")),
                Some(patches) => read_parts(&mut files, pad, &own, patches, settings.contact_law)?,
            },
        };
        let mut contents = read.contents;
        contents.push(format!("files      {}", files.names().join(", ")));
        Ok(Self {
            name: own.name.clone(),
            model: read.model,
            geometry: read.geometry,
            pairs: read.pairs,
            settings,
            common_tables,
            contact_patches,
            state: read.state.map(|state| state.written_as(state_keys.unwrap_or_default())),
            matrix_files: matrix_files(&own),
            path: path.to_owned(),
            content_hash: files.content_hash(),
            contents,
        })
    }

    /// Adds the damping of modes of the parts, `C = M Φ diag(2 ζ ω) Φᵀ M`, to the equation of motion. A list of ratios
    /// is of the lowest modes; a single ratio is of all modes up to [`DAMPED_BAND`] times the band (that of `[band]`, else
    /// [`DEFAULT_BAND_HZ`]). Without damping ratios this does nothing. `progress` as in [`Self::keep_modes`].
    ///
    /// # Errors
    /// [`RigError::Reduction`].
    pub fn damp_modes(
        &mut self,
        engine: &dyn Engine,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(usize, Progress),
    ) -> Result<(), RigError> {
        let band_hz = self.settings.band_max_hz.unwrap_or(DEFAULT_BAND_HZ);
        for part in 0..self.geometry.len() {
            let (wanted, every) = match &self.geometry[part].damping_ratio {
                DampedModes::None => continue,
                DampedModes::Every(ratio) => (Wanted::Below(DAMPED_BAND * std::f64::consts::TAU * band_hz), *ratio),
                DampedModes::Lowest(ratios) => (Wanted::Lowest(ratios.len()), 0.0),
            };
            let FullPart { name, mass, stiffness } = &self.model.parts[part];
            let report = &mut |step| progress(part, step);
            let modes = Analysed::new(engine, name, mass, stiffness)
                .and_then(|analysed| analysed.modes(wanted, memory_limit_bytes, report))
                .map_err(|source| RigError::Reduction { file: self.path.display().to_string(), source })?;
            let ratios = match &self.geometry[part].damping_ratio {
                DampedModes::Lowest(ratios) => ratios.clone(),
                DampedModes::None | DampedModes::Every(_) => vec![every; modes.omega_squared.len()],
            };
            self.model.damp_modes(part, &modes, &ratios);
        }
        Ok(())
    }

    /// Computes the lowest modes of pad and disc by `engine`: `wanted` has an entry for each. If `with_residual`, the residual
    /// flexibility and inertia of the truncated modes are computed too. `progress` receives the index of the part and
    /// its progress.
    ///
    /// # Errors
    /// [`RigError::Reduction`] with the errors of [`keep_modes`], naming the file of the offending matrix.
    pub fn keep_modes(
        &self,
        engine: &dyn Engine,
        wanted: &[Wanted],
        with_residual: bool,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(usize, Progress),
    ) -> Result<Vec<Kept>, RigError> {
        let rows: Vec<Vec<Option<usize>>> = self.geometry.iter().map(PartGeometry::interface_rows).collect();
        let parts: Vec<Substructure<'_>> = (self.model.parts.iter().zip(&rows).zip(wanted))
            .map(|((part, rows), &wanted)| Substructure {
                name: &part.name,
                mass: &part.mass,
                stiffness: &part.stiffness,
                rows,
                wanted,
            })
            .collect();
        keep_modes(engine, &parts, with_residual, memory_limit_bytes, progress).map_err(|source| {
            let file = match &source {
                ReductionError::Indefinite { what, .. }
                | ReductionError::NegativeStiffness { what, .. }
                | ReductionError::Unsymmetric { what, .. } => self.file_of(what),
                _ => self.path.display().to_string(),
            };
            RigError::Reduction { file, source }
        })
    }

    /// The path of the full model, followed in brackets by the file of the matrix `field`, such as `pad.mass`.
    pub fn file_of(&self, field: &str) -> String {
        let path = self.path.display();
        match self.matrix_files.iter().find(|(known, _)| known == field) {
            Some((_, file)) => format!("{path} ({file})"),
            None => path.to_string(),
        }
    }

    /// A description of the full model, in a few lines of text.
    pub fn describe(&self) -> String {
        let mut lines = vec![format!("full model {}", self.name)];
        lines.extend(self.contents.iter().cloned());
        lines.push(match self.settings.band_max_hz {
            Some(max_hz) => format!("band       up to {max_hz} Hz"),
            None => "band       not given".to_owned(),
        });
        let reference = &self.settings.reference;
        lines.push(format!(
            "reference  {} N, {} rad/s, friction coefficient {}",
            reference.normal_load_n, reference.disc_speed_rad_s, reference.friction_coefficient
        ));
        lines.push(format!("hash       {}", self.content_hash));
        lines.join("\n")
    }
}

impl PartGeometry {
    /// The row of each of x, y and z of every interface node; `None` if that direction is constrained.
    pub fn interface_rows(&self) -> Vec<Option<usize>> {
        let row_of: HashMap<(usize, usize), usize> =
            self.rows.iter().enumerate().map(|(row, &place)| (place, row)).collect();
        let places = self.interface.iter().flat_map(|&node| (0..3).map(move |direction| (node, direction)));
        places.map(|place| row_of.get(&place).copied()).collect()
    }

    /// Positions of the interface nodes, m.
    pub fn interface_m(&self) -> Vec<[f64; 3]> {
        self.interface.iter().map(|&node| self.nodes_m[node]).collect()
    }
}

/// Field and file name of each matrix of pad and disc.
fn matrix_files(raw: &RawFullModel) -> Vec<(String, String)> {
    let parts = [("pad", &raw.pad), ("disc", &raw.disc)];
    let named = parts.into_iter().filter_map(|(name, part)| Some((name, part.as_ref()?)));
    named
        .flat_map(|(name, part)| {
            let optional = [
                ("gyroscopic", &part.gyroscopic),
                ("spin", &part.spin),
                ("stress_stiffening", &part.stress_stiffening),
            ];
            [("stiffness", &part.stiffness), ("mass", &part.mass)]
                .into_iter()
                .chain(optional.into_iter().filter_map(|(key, file)| Some((key, file.as_ref()?))))
                .map(|(key, file)| (format!("{name}.{key}"), file.clone()))
                .collect::<Vec<_>>()
        })
        .collect()
}

/// The result of reading a full model of either kind.
struct ReadModel {
    model: FullModel,
    geometry: Vec<PartGeometry>,
    pairs: Vec<Pair>,
    state: Option<FullState>,
    contents: Vec<String>,
}

/// Reads `[pad]`, `[disc]`, their contact patches and `[contact_state]` of the file `own`.
fn read_parts(
    files: &mut Files,
    pad: &RawPart,
    own: &RawFullModel,
    patches: &[RawPatch],
    contact_law: ContactLaw,
) -> Result<ReadModel, RigError> {
    let toml = files.toml.clone();
    let turning = [("gyroscopic", &pad.gyroscopic), ("spin", &pad.spin), ("stress_stiffening", &pad.stress_stiffening)];
    if let Some((key, _)) = turning.into_iter().find(|(_, file)| file.is_some()) {
        let (field, value) = (format!("pad.{key}"), "is given for the pad, which does not turn".to_owned());
        return Err(RigError::Kind { file: toml, field, value, limit: format!("disc.{key}") });
    }
    // Both at the same time. Hashes and errors are those of reading the pad first.
    let mut of_disc = files.beside();
    let (pad, disc) = std::thread::scope(|scope| {
        let disc = own.disc.as_ref().map(|disc| scope.spawn(|| part::read(&mut of_disc, "disc", disc)));
        let pad = part::read(files, "pad", pad);
        (pad, disc.map(|disc| disc.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))))
    });
    let (pad, disc) = (pad?, disc.transpose()?);
    files.append(of_disc);
    let (pad_m, disc_m) = (pad.geometry.interface_m(), disc.as_ref().map(|disc| disc.geometry.interface_m()));
    let patch::Contacts { mut pairs, stiffness_n_per_m, damping_n_s_per_m } =
        patch::contacts(&toml, patches, &pad_m, disc_m.as_deref())?;
    for pair in &mut pairs {
        pair.pad_node = pad.geometry.interface[pair.pad_node];
        if let Some(disc) = &disc {
            pair.disc.iter_mut().for_each(|(node, _)| *node = disc.geometry.interface[*node]);
        }
    }
    let offset = pad.part.mass.nrows();
    let rows = |direction: &dyn Fn(&Pair) -> [f64; 3]| -> Vec<SparseRow> {
        pairs
            .iter()
            .map(|pair| {
                let along = direction(pair);
                let mut row = displacement(&pad.row_of, pair.pad_node, along, 1.0, 0);
                for &(node, weight) in &pair.disc {
                    let of_disc = disc.as_ref().map(|disc| displacement(&disc.row_of, node, along, -weight, offset));
                    row.extend(of_disc.into_iter().flatten());
                }
                row
            })
            .collect()
    };
    let contact = FullContact {
        normal: rows(&|pair| pair.normal),
        sliding: rows(&|pair| pair.sliding),
        lateral: rows(&|pair| pair.lateral),
        stiffness_n_per_m,
        damping_n_s_per_m,
        radius_m: pairs.iter().map(|pair| pair.radius_m).collect(),
        steady: None,
    };
    let state = own.contact_state.as_ref().map(|raw| state::read(files, raw, &pad, &contact.stiffness_n_per_m));
    let state = state.transpose()?;
    if state.is_some() && contact_law.exponent != 0.0 {
        let source = ModelError::StateLoadExponent { exponent: contact_law.exponent };
        return Err(RigError::Model { file: toml, source });
    }
    let mut contents = vec!["kind       pad and disc of a finite-element program".to_owned()];
    for part in std::iter::once(&pad).chain(&disc) {
        contents.push(format!(
            "{:<10} {} degrees of freedom, {} nodes, {} at the interface, {} entries of stiffness",
            part.part.name,
            part.part.mass.nrows(),
            part.geometry.nodes_m.len(),
            part.geometry.interface.len(),
            part.part.stiffness.compute_nnz()
        ));
    }
    if disc.is_none() {
        contents.push("disc       rigid".to_owned());
    }
    for part in std::iter::once(&pad).chain(&disc) {
        let [alpha, beta] = part.rayleigh;
        if part.rayleigh != [0.0; 2] {
            contents.push(format!(
                "damping    of the {}: {alpha} 1/s times its mass, {beta} s times its stiffness",
                part.part.name
            ));
        }
        match &part.geometry.damping_ratio {
            DampedModes::None => {}
            DampedModes::Every(ratio) => {
                contents.push(format!("damping    of the {}: {ratio} of its modes", part.part.name));
            }
            DampedModes::Lowest(ratios) => {
                contents.push(format!("damping    of the {}: of its {} lowest modes", part.part.name, ratios.len()));
            }
        }
        let PartTurning { gyroscopic, spin, stress_stiffening } = &part.turning;
        let known = [("gyroscopic", gyroscopic), ("spin", spin), ("stress stiffening", stress_stiffening)];
        let known: Vec<&str> = known.into_iter().filter_map(|(name, matrix)| matrix.as_ref().map(|_| name)).collect();
        if !known.is_empty() {
            contents.push(format!("rotation   of the {}: {} terms", part.part.name, known.join(", ")));
        }
    }
    let coincident = pairs.iter().filter(|pair| pair.disc.len() <= 1).count();
    contents.push(format!(
        "contact    {} pairs, {:.6e} N/m in all; {coincident} of coincident nodes, {} interpolated on the disc",
        pairs.len(),
        contact.stiffness_n_per_m.iter().sum::<f64>(),
        pairs.len() - coincident
    ));
    contents.extend(state.iter().flat_map(|state| state.describe(pairs.len())));
    let (mut parts, mut geometry): (Vec<FullPart>, Vec<PartGeometry>) = (vec![], vec![]);
    let mut own = vec![];
    for part in std::iter::once(pad).chain(disc) {
        parts.push(part.part);
        geometry.push(part.geometry);
        own.push((part.rayleigh, part.turning));
    }
    let mut model = FullModel {
        parts,
        stiffness: vec![],
        damping: vec![],
        modal_damping: vec![],
        contact: Some(contact),
        contact_law,
    };
    for (part, ([alpha_per_s, beta_s], turning)) in own.iter().enumerate() {
        let added = model.damp(part, *alpha_per_s, *beta_s).and_then(|()| model.turn(part, turning));
        added.map_err(|source| RigError::Reduction { file: toml.clone(), source })?;
    }
    Ok(ReadModel { model, geometry, pairs, state, contents })
}

/// A sparse row that gives `weight` times the displacement of `node` along a direction. Constrained directions
/// contribute nothing. `offset` is the first row of the part.
fn displacement(
    row_of: &HashMap<(usize, usize), usize>,
    node: usize,
    along: [f64; 3],
    weight: f64,
    offset: usize,
) -> SparseRow {
    let row = |(axis, component): (usize, f64)| {
        row_of.get(&(node, axis)).filter(|_| component != 0.0).map(|row| (offset + row, weight * component))
    };
    along.into_iter().enumerate().filter_map(row).collect()
}

/// Reads `[system]`. Its `modes`, which only a rig uses, are ignored.
fn read_system(files: &mut Files, raw: &RawSystem, settings: &Settings) -> Result<ReadModel, RigError> {
    let file = files.toml.clone();
    if raw.stiffness.is_empty() {
        let (field, limit) = ("system.stiffness".to_owned(), "at least one [[system.stiffness]]".to_owned());
        return Err(RigError::MissingKey { file, field, limit });
    }
    system::check_terms(&file, raw)?;
    let mass = part::mass(files, "system.mass", &raw.mass)?;
    let n = mass.nrows();
    let mut contents = vec![
        "kind       system of matrices".to_owned(),
        format!("mass       {}, {n} degrees of freedom, {} entries", raw.mass, mass.compute_nnz()),
    ];
    let mut terms = |key: &str, raw: &[RawTerm]| -> Result<Vec<SparseTerm>, RigError> {
        let mut terms = vec![];
        for (index, raw) in raw.iter().enumerate() {
            let field = |name: &str| format!("system.{key}[{index}].{name}");
            let (law, _) = system::checked_law(&file, &field("scale"), &raw.scale, &settings.reference)?;
            let (row_of, held) = (&HashMap::new(), &mut HashSet::new());
            let expected = part::Expected { rows: n, source: "system.mass", row_of, held };
            let matrix = part::matrix(files, &field("matrix"), &raw.matrix, 1.0, Some(expected))?;
            let symmetry = if crate::reduction::is_symmetric(&matrix) { "symmetric" } else { "unsymmetric" };
            let entries = matrix.compute_nnz();
            contents.push(format!("{key:<10} {} times {}, {symmetry}, {entries} entries", raw.matrix, raw.scale));
            terms.push(SparseTerm { matrix, law });
        }
        Ok(terms)
    };
    let (stiffness, damping) = (terms("stiffness", &raw.stiffness)?, terms("damping", &raw.damping)?);
    let none = SparseMatrix::try_new_from_triplets(n, n, &[]).map_err(|error| RigError::Shape {
        file: file.clone(),
        field: "system.mass".to_owned(),
        value: format!("{n}x{n} ({error:?})"),
        limit: "one that fits into memory".to_owned(),
    })?;
    let part = FullPart { name: "system".to_owned(), mass, stiffness: none };
    let contact_law = settings.contact_law;
    let model = FullModel { parts: vec![part], stiffness, damping, modal_damping: vec![], contact: None, contact_law };
    Ok(ReadModel { model, geometry: vec![], pairs: vec![], state: None, contents })
}
