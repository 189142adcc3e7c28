//! Writes the full model of the tribometer: a TOML file with its matrices, nodes and contact patch.

use std::io::Write;
use std::path::Path;

use super::error::ExportError;
use super::{write_deck, write_mesh, write_skew, write_symmetric};
use crate::fem::Turning;
use crate::fem::tribometer::{AXIS, CONTACT_STIFFNESS_N_PER_M, Part, Tribometer};
use crate::files::whole_file::write_whole;

/// Upper end of the band: includes the paper's first 18 modes, which reach 3256 Hz, with a margin.
const BAND_HZ: f64 = 4000.0;
/// Largest friction coefficient searched, the largest in the paper.
const MU_MAX: f64 = 1.0;
/// Roughness height of a lining, m, and its pressure at closure 0, Pa. The law is that of rough surfaces whose heights are
/// distributed exponentially (Greenwood and Williamson, "Contact of nominally flat surfaces", Proc. R. Soc. A 295 (1966)
/// 300-319), which is applied to brake pads too (for instance EuroBrake 2016, paper EB2016-FBR-025). The height is assumed:
/// the contact plateaus of a lining rise by some micrometres. The pressure at closure 0 only shifts all closures.
const LINING_ROUGHNESS_M: f64 = 5e-6;
const LINING_PRESSURE_PA: f64 = 1e4;
/// Largest friction coefficient searched with a lining: beyond, the pad diverges at higher loads, and then jams.
const LINING_MU_MAX: f64 = 0.6;
/// Number of natural frequencies a deck computes.
const DECK_MODES: usize = 20;

/// What a full model of the tribometer holds besides its springs that are always closed.
#[derive(Clone, Copy, Debug, Default)]
pub struct Besides {
    /// The matrices of the turning disc.
    pub rotation: bool,
    /// A contact state with the law of a lining, in place of the springs.
    pub lining: bool,
}

/// Writes the full model into `folder`, which is created if necessary. For each part: matrices, nodes, rows and a
/// CalculiX deck; for both: the mesh as VTK. `tribometer.toml` is written last, so it exists only if everything else
/// does. `say` receives the name of each file once it is written.
///
/// # Errors
/// [`ExportError`]: `Folder`, `Assembly`, `Turning`, `File`.
pub fn write_full_model(
    tribometer: &Tribometer,
    besides: Besides,
    folder: &Path,
    mut say: impl FnMut(&str),
) -> Result<(), ExportError> {
    let Besides { rotation, lining } = besides;
    let (name, mu_max) = if lining { ("tribometer-lining", LINING_MU_MAX) } else { ("tribometer", MU_MAX) };
    std::fs::create_dir_all(folder)
        .map_err(|source| ExportError::Folder { folder: folder.display().to_string(), source })?;
    let mut toml = format!(
        "# A pad-on-disc tribometer of the paper's kind, with dimensions of this project: {} degrees of freedom.\n\
         name = \"{name}\"\n\n[band]\nmax_hz = {BAND_HZ:?}\n\n[search]\nmu_max = {mu_max:?}\n",
        tribometer.dof()
    );
    if lining {
        toml += &lining_state(tribometer);
    }
    for (name, part) in [("pad", &tribometer.pad), ("disc", &tribometer.disc)] {
        toml += &write_part(name, part, folder, &mut say)?;
    }
    // Keys of [disc], the table written last.
    if rotation {
        toml += &write_turning(&tribometer.disc, folder, &mut say)?;
    }
    let mesh = "tribometer.vtk";
    let meshes = [&tribometer.pad.structure.mesh, &tribometer.disc.structure.mesh];
    write_whole(&folder.join(mesh), |out| write_mesh(&meshes, "squealcast tribometer", out))?;
    say(mesh);
    toml += &format!(
        "\n[[contact_patch]]\naxis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 1.0, 0.0]\n\
         normal = [0.0, 1.0, 0.0]\nstiffness_n_per_m = {CONTACT_STIFFNESS_N_PER_M:e}\n"
    );
    write_whole(&folder.join("tribometer.toml"), |out| out.write_all(toml.as_bytes()))?;
    say("tribometer.toml");
    Ok(())
}

/// The table of the contact state of a lining. The force sensor below the bearing measures the contact force: the bracket
/// takes most of a load on the spring holder.
fn lining_state(tribometer: &Tribometer) -> String {
    let area_m2 = tribometer.contact_area_m2 / tribometer.pad.interface.len() as f64;
    let nodes: Vec<String> = tribometer.loaded.iter().map(ToString::to_string).collect();
    format!(
        "\n# Rough surfaces whose heights are distributed exponentially (Greenwood and Williamson, Proc. R. Soc. A 295 (1966)\n\
         # 300-319); the roughness height is assumed. The force sensor measures the contact force; the load presses on the\n\
         # spring holder.\n\
         [contact_state]\nlaw = \"exponential\"\npressure_pa = {LINING_PRESSURE_PA:?}\n\
         roughness_m = {LINING_ROUGHNESS_M:?}\narea_m2 = {area_m2:e}\nmeasured = \"contact-force\"\n\
         load_nodes = [{}]\nload_direction = [0.0, -1.0, 0.0]\n",
        nodes.join(", ")
    )
}

/// Writes the files of one part and returns its TOML table.
fn write_part(name: &str, part: &Part, folder: &Path, say: &mut impl FnMut(&str)) -> Result<String, ExportError> {
    let structure = &part.structure;
    let file = |what: &str| format!("{name}-{what}");
    let deck = format!("{name}.inp");
    write_whole(&folder.join(&deck), |out| write_deck(structure, &format!("{name} of a tribometer"), DECK_MODES, out))?;
    say(&deck);
    let assembled = structure.assemble().map_err(|source| ExportError::Assembly { part: name.to_owned(), source })?;
    for (what, matrix, unit) in [("stiffness", &assembled.stiffness, "N/m"), ("mass", &assembled.mass, "kg")] {
        let file = file(&format!("{what}.mtx"));
        let comment = format!("{what} of the {name}, {unit}, interface free; rows as in {name}-rows.csv");
        write_whole(&folder.join(&file), |out| write_symmetric(matrix, &comment, out))?;
        say(&file);
    }
    let nodes = file("nodes.csv");
    write_whole(&folder.join(&nodes), |out| {
        writeln!(out, "x_m,y_m,z_m")?;
        structure.mesh.nodes_m.iter().try_for_each(|[x, y, z]| writeln!(out, "{x:e},{y:e},{z:e}"))
    })?;
    say(&nodes);
    let rows = file("rows.csv");
    write_whole(&folder.join(&rows), |out| {
        writeln!(out, "node,direction")?;
        assembled.rows.iter().try_for_each(|&(node, direction)| writeln!(out, "{node},{}", ["x", "y", "z"][direction]))
    })?;
    say(&rows);
    let interface: Vec<String> = part.interface.iter().map(ToString::to_string).collect();
    Ok(format!(
        "\n[{name}]\nstiffness = \"{}\"\nmass = \"{}\"\nnodes = \"{nodes}\"\nrows = \"{rows}\"\n\
         interface_nodes = [{}]\n",
        file("stiffness.mtx"),
        file("mass.mtx"),
        interface.join(", ")
    ))
}

/// Writes the matrices of the turning disc and returns their keys.
fn write_turning(disc: &Part, folder: &Path, say: &mut impl FnMut(&str)) -> Result<String, ExportError> {
    let Turning { gyroscopic, spin, stiffening } =
        disc.structure.turning(&AXIS).map_err(|source| ExportError::Turning { part: "disc".to_owned(), source })?;
    let mut keys = String::new();
    let matrices = [("gyroscopic", &gyroscopic), ("spin", &spin), ("stress_stiffening", &stiffening)];
    for (key, matrix) in matrices {
        let file = format!("disc-{}.mtx", key.replace('_', "-"));
        let comment = format!("{key} matrix of the disc, kg; rows as in disc-rows.csv");
        write_whole(&folder.join(&file), |out| match key {
            "gyroscopic" => write_skew(matrix, &comment, out),
            _ => write_symmetric(matrix, &comment, out),
        })?;
        say(&file);
        keys += &format!("{key} = \"{file}\"\n");
    }
    Ok(keys)
}
