"""Writes the modes of a pad and of a disc with pyuff, and the numbers that pyuff reads back as NPZ.

    pyuff_rig.py DIR

Leaves pad.unv, disc.uff (datasets 55 with 2411 and with 15 nodes, the latter in millimetres by a dataset 164), and pad.npz,
disc.npz with the same digits.
"""

import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyuff


def modes(count, nodes, seed):
    random = np.random.default_rng(seed)
    return np.sort(random.uniform(300.0, 3000.0, count)), random.normal(size=(nodes, 3, count))


def write(path, labels, nodes, hz, phi, mass, zeta, node_dataset, millimetres):
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    units = {"type": 164, "units_code": 5 if millimetres else 1, "units_description": "mm" if millimetres else "SI",
             "temp_mode": 1, "length": 1000.0 if millimetres else 1.0, "force": 1000.0 if millimetres else 1.0,
             "temp": 1.0, "temp_offset": 0.0}
    file.write_sets(units, "add")
    scale = 1000.0 if millimetres else 1.0
    zeros = np.zeros(len(labels), dtype=int)
    file.write_sets({"type": node_dataset, "node_nums": labels, "def_cs": zeros, "disp_cs": zeros, "color": zeros,
                     "x": scale * nodes[:, 0], "y": scale * nodes[:, 1], "z": scale * nodes[:, 2]}, "add")
    for k, frequency in enumerate(hz):
        file.write_sets({"type": 55, "model_type": 1, "id1": "NONE", "id2": "NONE", "id3": "NONE", "id4": "NONE",
                         "id5": "NONE", "analysis_type": 2, "data_ch": 2, "spec_data_type": 8, "data_type": 2,
                         "load_case": 1, "mode_n": k + 1, "freq": frequency, "modal_m": mass[k],
                         "modal_damp_vis": zeta[k], "modal_damp_his": 0.0, "node_nums": labels,
                         "r1": phi[:, 0, k], "r2": phi[:, 1, k], "r3": phi[:, 2, k]}, "add")
    return pyuff.UFF(str(path))


def npz(path, file, node_dataset, millimetres):
    sets = file.read_sets()
    placed = next(s for s in sets if s["type"] == node_dataset)
    shapes = [s for s in sets if s["type"] == 55]
    nodes = np.column_stack([placed["x"], placed["y"], placed["z"]]) / (1000.0 if millimetres else 1.0)
    phi = np.stack([np.column_stack([s["r1"], s["r2"], s["r3"]]) / np.sqrt(s["modal_m"]) for s in shapes], axis=2)
    np.savez(path, omega_rad_s=2 * np.pi * np.array([s["freq"] for s in shapes]), phi=phi, nodes_m=nodes,
             damping_ratio=np.array([s["modal_damp_vis"] for s in shapes]))


def main():
    folder = Path(sys.argv[1])
    x, y = np.meshgrid(np.linspace(0.09, 0.11, 4), np.linspace(-0.01, 0.01, 3), indexing="ij")
    pad_nodes = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.02)])
    x, y = np.meshgrid(np.linspace(0.085, 0.115, 5), np.linspace(-0.015, 0.015, 6), indexing="ij")
    disc_nodes = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.02)])
    for name, nodes, count, dataset, millimetres in [("pad.unv", pad_nodes, 5, 2411, False),
                                                     ("disc.uff", disc_nodes, 6, 15, True)]:
        hz, phi = modes(count, len(nodes), count)
        labels = 100 + 7 * np.arange(len(nodes))
        mass, zeta = np.linspace(1.0, 2.5, count), np.linspace(0.001, 0.01, count)
        file = write(folder / name, labels, nodes, hz, phi, mass, zeta, dataset, millimetres)
        npz(folder / (Path(name).stem + ".npz"), file, dataset, millimetres)
    print(f"pyuff {version('pyuff')}, numpy {version('numpy')}")


main()
