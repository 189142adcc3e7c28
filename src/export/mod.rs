//! Writes finite-element models to files: matrices, full models, decks and meshes for other programs, and reduced
//! models as rig files.

mod basis;
mod calculix;
mod error;
mod full_model;
mod matrix_market;
mod rig;
mod state;
mod vtk;

pub use basis::basis_rig;
pub use calculix::write_deck;
pub use error::ExportError;
pub use full_model::{Besides, write_full_model};
pub use matrix_market::{write_skew, write_symmetric};
pub use rig::{HASH_DIGITS, ModalSide, modal_rig, modal_sides, source_remarks};
pub use state::{StateOfRig, state_on_basis, state_on_modes};
pub use vtk::write_mesh;
