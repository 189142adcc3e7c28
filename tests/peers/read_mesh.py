"""Reads the mesh of a tribometer's folder with meshio and compares it with the tables of nodes in the folder.

    read_mesh.py DIR

Prints the version and the numbers of nodes, bricks and components.
"""

import sys
from pathlib import Path

import meshio
import numpy as np

folder = Path(sys.argv[1])
mesh = meshio.read(folder / "tribometer.vtk")
nodes = np.vstack([np.loadtxt(folder / f"{part}-nodes.csv", delimiter=",", skiprows=1) for part in ("pad", "disc")])
assert mesh.points.dtype.itemsize == 8 and np.array_equal(mesh.points, nodes), "nodes differ from the tables"
assert [block.type for block in mesh.cells] == ["hexahedron"], mesh.cells
corners = mesh.points[mesh.cells[0].data]
along = [corners[:, k] - corners[:, 0] for k in (1, 3, 4)]
volumes = np.einsum("ij,ij->i", np.cross(along[0], along[1]), along[2])
assert volumes.min() > 0.0, "bricks turned inside out"
components = np.unique(mesh.cell_data["component"][0])
assert np.array_equal(components, np.arange(len(components))), components
print(f"meshio {meshio.__version__}: {len(nodes)} nodes, {len(volumes)} bricks, {len(components)} components")
