#!/usr/bin/env python3
"""Full models written by numpy and scipy, and the dense eigenvalues of their matrices.

    scipy_full.py DIR

writes full models of a pad on a ring (Matrix Market, CSV, TOML) into DIR and prints one JSON object: the version of the
program and, for every model, its file, band and cases: operating points with all roots of

    M q'' + C q' + K q = 0,    ω > 0
    C = Σ_parts (α M_p + β K_p + M_p Φ diag(2 ζ ω) Φᵀ M_p) + 2 Ω H + Bnᵀ Cc Bn + sμ Btᵀ Cc Bn
    K = diag(K_p) + Ω² (S - L) + (Bn + sμ Bt)ᵀ Kc Bn

Everything is assembled here from these formulas; nothing of squealcast is used.
"""

import json
import sys
from pathlib import Path

import numpy as np
import scipy
from scipy.io import mmwrite
from scipy.sparse import coo_matrix

# Band of the model with a single damping ratio of a part, Hz.
BAND_OF_RATIO = 5500.0
RADII, AROUND, UNDER_PAD = [0.095, 0.105], 28, 6
random = np.random.default_rng(20260)


def springs(nodes, near, scale):
    """Stiffness of springs between all nodes closer than `near`, and a soft one from every node to the ground."""
    n = 3 * len(nodes)
    matrix = 1e-3 * scale * np.eye(n)
    for i in range(len(nodes)):
        for j in range(i):
            along = nodes[i] - nodes[j]
            length = np.linalg.norm(along)
            if length < near:
                along = along / length
                block = scale * random.uniform(0.5, 1.5) * (0.3 * np.eye(3) + 0.7 * np.outer(along, along))
                a, b = slice(3 * i, 3 * i + 3), slice(3 * j, 3 * j + 3)
                matrix[a, a] += block
                matrix[b, b] += block
                matrix[a, b] -= block
                matrix[b, a] -= block
    return matrix


def masses(nodes, stiffness, mass):
    """Lumped masses with a little coupling where springs are."""
    n = 3 * len(nodes)
    diagonal = mass * np.repeat(random.uniform(0.8, 1.2, len(nodes)), 3)
    coupling = 0.02 * mass * ((stiffness != 0) & ~np.eye(n, dtype=bool))
    return np.diag(diagonal) + coupling


def ring():
    """Nodes, and the derivative along the circumference by central differences of Cartesian components."""
    angles = 2 * np.pi * np.arange(AROUND) / AROUND
    nodes = np.array([[r * np.cos(a), 0.0, -r * np.sin(a)] for r in RADII for a in angles])
    difference = np.zeros((len(nodes), len(nodes)))
    for r in range(len(RADII)):
        for a in range(AROUND):
            difference[r * AROUND + a, r * AROUND + (a + 1) % AROUND] += 1 / (angles[1] * 2)
            difference[r * AROUND + a, r * AROUND + (a - 1) % AROUND] -= 1 / (angles[1] * 2)
    return nodes, np.kron(difference, np.eye(3))


class Model:
    def __init__(self, folder, name, *, alpha=(0.0, 0.0), beta=(0.0, 0.0), ratios=(None, None), rotation=False, contact_damping=0.0):
        self.nodes_disc, along = ring()
        below = [r * AROUND + a for r in range(len(RADII)) for a in range(UNDER_PAD)]
        layers = [self.nodes_disc[below] + [0.0, 0.01 * layer, 0.0] for layer in range(3)]
        self.nodes_pad = np.vstack(layers)
        self.pairs = [(k, node) for k, node in enumerate(below)]
        stiffness = [springs(self.nodes_pad, 0.026, 2e7), springs(self.nodes_disc, 0.03, 5e7)]
        mass = [masses(self.nodes_pad, stiffness[0], 0.03), masses(self.nodes_disc, stiffness[1], 0.05)]
        # Exaggerated tenfold, so that rotation matters at the speeds of a tribometer.
        gyroscopic = 10 * 0.05 * along
        spin = 100 * 0.05 * along.T @ along
        stiffening = 0.6 * spin + 0.1 * np.diag(random.uniform(0, 1, len(spin)))
        self.n = [len(m) for m in mass]
        self.mass, self.stiffness = scipy.linalg.block_diag(*mass), scipy.linalg.block_diag(*stiffness)
        parts = zip(mass, stiffness, alpha, beta)
        self.damping = scipy.linalg.block_diag(*[a * m + b * k for m, k, a, b in parts])
        of_modes = [self.modal(m, k, zeta) for m, k, zeta in zip(mass, stiffness, ratios)]
        self.damping = self.damping + scipy.linalg.block_diag(*of_modes)
        self.turning = rotation
        zero = np.zeros((self.n[0], self.n[0]))
        self.gyroscopic = scipy.linalg.block_diag(zero, gyroscopic) * rotation
        self.of_square = scipy.linalg.block_diag(zero, stiffening - spin) * rotation
        self.contact_stiffness = 1e7 * random.uniform(0.5, 1.5, len(self.pairs))
        self.contact_damping = contact_damping
        self.rows()
        self.band_hz = BAND_OF_RATIO if isinstance(ratios[0], float) else self.band()
        self.write(folder, name, mass, stiffness, [gyroscopic, spin, stiffening], alpha, beta, ratios)

    def modal(self, mass, stiffness, ratios):
        """M Φ diag(2 ζ ω) Φᵀ M of the lowest modes; a number is of all modes below 2.5 times the band."""
        if ratios is None:
            return np.zeros_like(mass)
        square, phi = scipy.linalg.eigh(stiffness, mass)
        omega = np.sqrt(square)
        if isinstance(ratios, float):
            ratios = ratios * (omega < 2.5 * 2 * np.pi * BAND_OF_RATIO)
        zeta = np.zeros(len(omega))
        zeta[: len(ratios)] = ratios
        return mass @ phi @ np.diag(2 * zeta * omega) @ phi.T @ mass

    def rows(self):
        c, n = len(self.pairs), sum(self.n)
        self.along_n, self.along_t = np.zeros((c, n)), np.zeros((c, n))
        for row, (pad, disc) in enumerate(self.pairs):
            sliding = np.cross([0.0, 1.0, 0.0], self.nodes_pad[pad])
            sliding /= np.linalg.norm(sliding)
            for rows, direction in [(self.along_n, [0.0, 1.0, 0.0]), (self.along_t, sliding)]:
                rows[row, 3 * pad : 3 * pad + 3] = direction
                rows[row, self.n[0] + 3 * disc : self.n[0] + 3 * disc + 3] = -np.array(direction)

    def band(self):
        """In the middle of a gap between natural frequencies, above about 50 of them."""
        stiffness = self.stiffness + self.along_n.T @ np.diag(self.contact_stiffness) @ self.along_n
        omega = np.sqrt(scipy.linalg.eigh(stiffness, self.mass, eigvals_only=True))
        gap = 45 + np.argmax(np.diff(omega[45:56]))
        return (omega[gap] + omega[gap + 1]) / (4 * np.pi)

    def write(self, folder, name, mass, stiffness, turning, alpha, beta, ratios):
        def write(what, matrix, symmetry="symmetric"):
            mmwrite(folder / f"{name}-{what}.mtx", coo_matrix(matrix), symmetry=symmetry, precision=17)
            return f"{name}-{what}.mtx"

        limits = "[limits]\nfriction_coefficient = [-2.0, 2.0]\n[search]\nmu_max = 0.6\n"
        text = f'name = "{name}"\n[band]\nmax_hz = {self.band_hz}\n{limits}'
        parts = [("pad", self.nodes_pad, [p for p, _ in self.pairs]), ("disc", self.nodes_disc, [d for _, d in self.pairs])]
        for k, (part, nodes, interface) in enumerate(parts):
            lines = [",".join(repr(float(x)) for x in node) for node in nodes]
            (folder / f"{name}-{part}-nodes.csv").write_text("x_m,y_m,z_m\n" + "\n".join(lines) + "\n")
            rows = [f"{node},{axis}" for node in range(len(nodes)) for axis in "xyz"]
            (folder / f"{name}-{part}-rows.csv").write_text("node,direction\n" + "\n".join(rows) + "\n")
            text += f'[{part}]\nmass = "{write(part + "-mass", mass[k])}"\n'
            text += f'stiffness = "{write(part + "-stiffness", stiffness[k])}"\n'
            text += f'nodes = "{name}-{part}-nodes.csv"\nrows = "{name}-{part}-rows.csv"\ninterface_nodes = {interface}\n'
            text += "" if ratios[k] is None else f"damping_ratio = {ratios[k]}\n"
            for key, value in [("rayleigh_alpha_per_s", alpha[k]), ("rayleigh_beta_s", beta[k])]:
                text += f"{key} = {value}\n" if value else ""
        if self.turning:
            text += f'gyroscopic = "{write("gyroscopic", turning[0], "skew-symmetric")}"\n'
            text += f'spin = "{write("spin", turning[1], "general")}"\n'
            text += f'stress_stiffening = "{write("stiffening", turning[2])}"\n'
        text += "[[contact_patch]]\naxis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 1.0, 0.0]\n"
        text += f"normal = [0.0, 1.0, 0.0]\nstiffness_n_per_m = {self.contact_stiffness.tolist()}\n"
        text += f"damping_n_s_per_m = {self.contact_damping}\n"
        self.file = folder / f"{name}.toml"
        self.file.write_text(text)

    def roots(self, load, speed, friction):
        """All roots with ω > 0, by LAPACK's QR algorithm on the state space with M = L Lᵀ."""
        push = self.along_n + np.sign(speed) * friction * (abs(speed) >= 0.01) * self.along_t
        closed = load > 0
        stiffness = self.stiffness + speed**2 * self.of_square
        stiffness = stiffness + closed * push.T @ np.diag(self.contact_stiffness) @ self.along_n
        damping = self.damping + 2 * speed * self.gyroscopic
        damping = damping + closed * self.contact_damping * push.T @ self.along_n
        lower = np.linalg.cholesky(self.mass)
        whiten = lambda m: scipy.linalg.solve_triangular(lower, scipy.linalg.solve_triangular(lower, m, lower=True).T, lower=True).T
        stiffness, damping = whiten(stiffness), whiten(damping)
        n = len(stiffness)
        scale = np.sqrt(np.abs(np.diag(stiffness)).max())
        state = np.block([[np.zeros((n, n)), scale * np.eye(n)], [-stiffness / scale, -damping]])
        found = scipy.linalg.eigvals(state)
        return sorted([[r.real, r.imag] for r in found if r.imag > 0], key=lambda root: root[1])

    def case(self, load, speed, friction):
        point = {"normal_load_n": load, "disc_speed_rad_s": speed, "friction_coefficient": friction}
        return point | {"roots": self.roots(load, speed, friction)}

    def told(self, points):
        return {"file": str(self.file), "band_hz": self.band_hz, "cases": [self.case(*point) for point in points]}


def main():
    folder = Path(sys.argv[1])
    turning = Model(folder, "turning", rotation=True)
    rayleigh = Model(folder, "rayleigh", alpha=(4.0, 7.0), beta=(3e-7, 1e-7))
    both = Model(folder, "both", alpha=(0.0, 5.0), beta=(2e-7, 0.0), rotation=True, contact_damping=3.0)
    modal = Model(folder, "modal", ratios=(0.004, [0.0, 0.01, 0.002, 0.003, 0.008]), contact_damping=1.0)
    modal_turning = Model(folder, "modal-turning", ratios=(None, [0.005] * 30), beta=(1e-7, 0.0), rotation=True)
    models = {
        "modal": modal.told([(500.0, 13.0, 0.0), (500.0, 13.0, 0.4)]),
        "modal-turning": modal_turning.told([(500.0, -20.0, 0.3)]),
        "turning": turning.told([(500.0, 0.0, 0.3), (500.0, 13.0, 0.4), (500.0, -13.0, 0.4), (0.0, 60.0, 0.4), (500.0, 60.0, 0.2)]),
        "rayleigh": rayleigh.told([(500.0, 13.0, 0.0), (500.0, 13.0, 0.4)]),
        "both": both.told([(500.0, 13.0, 0.4), (500.0, 37.0, 0.25)]),
    }
    print(json.dumps({"scipy": scipy.__version__, "models": models}))


main()
