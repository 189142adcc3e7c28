//! Writes meshes as binary legacy VTK files, which ParaView, PyVista and VisIt open.

use std::io::{self, Write};

use vtkio::model::{
    Attribute, Attributes, ByteOrder, CellType, Cells, DataArray, DataSet, UnstructuredGridPiece, Version,
    VertexNumbers, Vtk,
};

use crate::fem::Mesh;

/// Writes meshes as one unstructured grid. Each brick carries the number of its component, counted across all meshes.
///
/// # Errors
/// Those of the writer; meshes with more nodes than the format can count.
pub fn write_mesh(meshes: &[&Mesh], title: &str, out: &mut impl Write) -> io::Result<()> {
    let points: Vec<f64> = meshes.iter().flat_map(|mesh| mesh.nodes_m.as_flattened()).copied().collect();
    let bricks: usize = meshes.iter().map(|mesh| mesh.bricks.len()).sum();
    let count = |count: usize| u32::try_from(count).map_err(io::Error::other);
    let (mut vertices, mut components) = (vec![], vec![]);
    let (mut first_node, mut first_component) = (0, 0);
    for mesh in meshes {
        for brick in &mesh.bricks {
            // VTK orders the corners of a hexahedron as a brick does.
            vertices.push(8);
            for node in brick.nodes {
                vertices.push(count(first_node + node)?);
            }
            components.push(count(first_component + brick.component)?);
        }
        first_node += mesh.nodes_m.len();
        first_component += mesh.components.len();
    }
    let grid = UnstructuredGridPiece {
        points: points.into(),
        cells: Cells {
            cell_verts: VertexNumbers::Legacy { num_cells: count(bricks)?, vertices },
            types: vec![CellType::Hexahedron; bricks],
        },
        data: Attributes {
            cell: vec![Attribute::DataArray(DataArray::scalars("component", 1).with_data(components))],
            ..Attributes::default()
        },
    };
    let file = Vtk {
        version: Version::new_legacy(3, 0),
        title: title.to_owned(),
        byte_order: ByteOrder::BigEndian,
        data: DataSet::inline(grid),
        file_path: None,
    };
    file.write_legacy(out).map_err(io::Error::other)
}
