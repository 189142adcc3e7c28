//! Meshes to look at: legacy VTK files, which ParaView, PyVista and VisIt open.
//!
//! Source: "VTK file formats", The VTK User's Guide (Kitware 2010), simple legacy formats.

use std::io::{self, Write};

use crate::fem::Mesh;

/// `VTK_HEXAHEDRON`, whose corners come in the order of [`crate::fem::Brick`].
const HEXAHEDRON: &str = "12";

/// Writes meshes as one unstructured grid with the number of each brick's component, counted on from mesh to mesh.
///
/// # Errors
/// What the writer reports.
pub fn write_mesh(meshes: &[&Mesh], title: &str, out: &mut impl Write) -> io::Result<()> {
    let nodes: usize = meshes.iter().map(|mesh| mesh.nodes_m.len()).sum();
    let bricks: usize = meshes.iter().map(|mesh| mesh.bricks.len()).sum();
    writeln!(out, "# vtk DataFile Version 3.0\n{title}\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {nodes} double")?;
    for [x, y, z] in meshes.iter().flat_map(|mesh| &mesh.nodes_m) {
        writeln!(out, "{x:e} {y:e} {z:e}")?;
    }
    writeln!(out, "CELLS {bricks} {}", 9 * bricks)?;
    let mut first = 0;
    for mesh in meshes {
        for brick in &mesh.bricks {
            writeln!(out, "8 {}", brick.nodes.map(|node| (first + node).to_string()).join(" "))?;
        }
        first += mesh.nodes_m.len();
    }
    writeln!(out, "CELL_TYPES {bricks}")?;
    for _ in 0..bricks {
        writeln!(out, "{HEXAHEDRON}")?;
    }
    writeln!(out, "CELL_DATA {bricks}\nSCALARS component int 1\nLOOKUP_TABLE default")?;
    let mut first = 0;
    for mesh in meshes {
        for brick in &mesh.bricks {
            writeln!(out, "{}", first + brick.component)?;
        }
        first += mesh.components.len();
    }
    Ok(())
}
