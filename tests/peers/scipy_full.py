#!/usr/bin/env python3
"""Full models written by numpy and scipy, and the dense eigenvalues of their matrices.

    scipy_full.py DIR

writes full models of a pad on a ring (Matrix Market, CSV, TOML) into DIR and prints one JSON object: the version of the
program and, for every model, its file, band and cases: operating points with all roots of

    M q'' + C q' + K q = 0,    ω > 0
    C = Σ_parts (α M_p + β K_p + M_p Φ diag(2 ζ ω) Φᵀ M_p) + 2 Ω H + Bnᵀ Cc Bn + sμ Btᵀ Cc Bn
    K = diag(K_p) + Ω² (S - L) + (Bn + sμ Bt)ᵀ Kc Bn

or, with a contact state, K0 q = F p + (Bn + sμ Bt)ᵀ N(δ), δ = -(h + Bn q), by Newton's method for all of q, and about it

    C = C0 + (Bn + sμ Bt)ᵀ diag(c k / k_ref) Bn + μ' Btᵀ diag(N) Bt + Bbᵀ diag(μ N / v) Bb
    K = K0 + (Bn + sμ Bt)ᵀ diag(k) Bn,    k = dN/dδ

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


def springs(nodes, near, scale, grounded=(1.0, 1.0, 1.0)):
    """Stiffness of springs between all nodes closer than `near`, and soft ones from every node to the ground."""
    n = 3 * len(nodes)
    matrix = 1e-3 * scale * np.diag(np.tile(grounded, len(nodes)))
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
    def __init__(self, folder, name, *, alpha=(0.0, 0.0), beta=(0.0, 0.0), ratios=(None, None), rotation=False, contact_damping=0.0, grounded=(1.0, 1.0, 1.0), state=None, slope=0.0, lateral=False):
        self.nodes_disc, along = ring()
        below = [r * AROUND + a for r in range(len(RADII)) for a in range(UNDER_PAD)]
        layers = [self.nodes_disc[below] + [0.0, 0.01 * layer, 0.0] for layer in range(3)]
        self.nodes_pad = np.vstack(layers)
        self.pairs = [(k, node) for k, node in enumerate(below)]
        stiffness = [springs(self.nodes_pad, 0.026, 2e7, grounded), springs(self.nodes_disc, 0.03, 5e7)]
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
        self.state, self.slope, self.lateral = state, slope, lateral
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
        self.along_n, self.along_t, self.along_b = np.zeros((c, n)), np.zeros((c, n)), np.zeros((c, n))
        self.radius = np.linalg.norm(self.nodes_pad[[pad for pad, _ in self.pairs]][:, [0, 2]], axis=1)
        for row, (pad, disc) in enumerate(self.pairs):
            sliding = np.cross([0.0, 1.0, 0.0], self.nodes_pad[pad])
            sliding /= np.linalg.norm(sliding)
            directions = [[0.0, 1.0, 0.0], sliding, np.cross([0.0, 1.0, 0.0], sliding)]
            for rows, direction in zip([self.along_n, self.along_t, self.along_b], directions):
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
        if self.state:
            text += f"[friction]\nslope_s_per_m = {self.slope}\nlateral_damping = {str(self.lateral).lower()}\n"
            text += self.state.table(folder, name, self)
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
        return self.eigenvalues(stiffness, damping)

    def roots_in(self, force, tangent, speed, friction):
        """All roots with ω > 0 about a contact state."""
        push = self.along_n + np.sign(speed) * friction * self.along_t
        stiffness = self.stiffness + speed**2 * self.of_square + push.T @ (tangent[:, None] * self.along_n)
        damper = self.contact_damping / self.contact_stiffness * tangent
        damping = self.damping + 2 * speed * self.gyroscopic + push.T @ (damper[:, None] * self.along_n)
        damping = damping + self.slope * self.along_t.T @ (force[:, None] * self.along_t)
        if self.lateral:
            across = friction * force / (abs(speed) * self.radius)
            damping = damping + self.along_b.T @ (across[:, None] * self.along_b)
        return self.eigenvalues(stiffness, damping)

    def eigenvalues(self, stiffness, damping):
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
        if self.state:
            force, tangent = self.state.solve(self, load, np.sign(speed) * friction)
            return point | {"force_n": force.tolist(), "roots": self.roots_in(force, tangent, speed, friction)}
        return point | {"roots": self.roots(load, speed, friction)}

    def told(self, points):
        return {"file": str(self.file), "band_hz": self.band_hz, "cases": [self.case(*point) for point in points]}


class State:
    """A contact law with its load."""

    def __init__(self, keys, gaps, load, measured="back-force"):
        self.keys, self.gaps, self.load, self.measured = keys, gaps, load, measured

    def table(self, folder, name, model):
        top = [24 + k for k in range(12)]
        self.row = np.zeros(sum(model.n))
        if self.load == "nodes":
            for node in top:
                self.row[3 * node + 1] = -1.0 / len(top)
            load = f"load_nodes = {top}\nload_direction = [0.0, -2.0, 0.0]\n"
        else:
            # Askew: most of the load at one end, a little of it along x.
            forces = [(node, axis, force) for k, node in enumerate(top) for axis, force in [("y", -(1 + k) / 78), ("x", 0.002)]]
            for node, axis, force in forces:
                self.row[3 * node + "xyz".index(axis)] = force
            if self.load == "table":
                lines = [f"{node},{axis},{force!r}" for node, axis, force in forces]
                (folder / f"{name}-load.csv").write_text("node,direction,force_n\n" + "\n".join(lines) + "\n")
                load = f'load_file = "{name}-load.csv"\n'
            else:
                mmwrite(folder / f"{name}-load.mtx", self.row[: model.n[0], None], precision=17)
                load = f'load_file = "{name}-load.mtx"\n'
        keys = "".join(f"{key} = {json.dumps(value)}\n" for key, value in self.keys.items())
        return f'[contact_state]\nmeasured = "{self.measured}"\ngap_m = {self.gaps.tolist()}\n{keys}{load}'

    def law(self, stiffness, delta):
        """Force and tangent stiffness of each pair."""
        keys, closed = self.keys, np.maximum(delta, 0.0)
        if keys["law"] == "linear":
            return stiffness * closed, stiffness * (delta > 0)
        if keys["law"] == "power":
            d, m = keys["reference_m"], keys["exponent"]
            return stiffness * d * (closed / d) ** m, stiffness * m * (closed / d) ** (m - 1)
        force = keys["area_m2"] * keys["pressure_pa"] * np.exp(np.minimum(delta / keys["roughness_m"], 50.0))
        return force, force / keys["roughness_m"]

    def solve(self, model, load, x):
        """Forces and tangent stiffness at a load and x = sμ, by steps from x = 0; every Newton step for all unknowns."""
        n = sum(model.n)
        # Lowered onto the disc, to begin with: no pair is open.
        q, back = np.concatenate([np.tile([0.0, -1e-5, 0.0], model.n[0] // 3), np.zeros(model.n[1])]), load
        for step in np.linspace(0.0, 1.0, 9):
            push = model.along_n + step * x * model.along_t
            for _ in range(200):
                delta = -(self.gaps + model.along_n @ q)
                force, tangent = self.law(model.contact_stiffness, delta)
                right = push.T @ force + back * self.row - model.stiffness @ q
                matrix = model.stiffness + push.T @ (tangent[:, None] * model.along_n)
                if self.measured == "contact-force":
                    column = np.append(-self.row, 0.0)[:, None]
                    last = (tangent @ model.along_n)[None, :]
                    matrix = np.hstack([np.vstack([matrix, last]), column])
                    right = np.append(right, force.sum() - load)
                change = np.linalg.solve(matrix, right)
                # Short steps where the law is steep; full ones near the end.
                largest = np.abs(model.along_n @ change[:n]).max()
                share = min(1.0, 1e-6 / largest)
                q, back = q + share * change[:n], back + share * (change[n] if len(change) > n else 0.0)
                if share == 1.0 and largest < 1e-12 * np.abs(delta).max():
                    break
        delta = -(self.gaps + model.along_n @ q)
        force, tangent = self.law(model.contact_stiffness, delta)
        off = np.abs(push.T @ force + back * self.row - model.stiffness @ q).max() / force.max()
        assert off < 1e-9, f"statics are off by {off:.1e}"
        return force, tangent


def crowned(height):
    """Initial gaps of the pairs, larger towards the ends of the pad and with radius."""
    return np.array([height * ((a - 2.5) ** 2 / 6.25 + 0.1 * r) for r in range(len(RADII)) for a in range(UNDER_PAD)])


def main():
    folder = Path(sys.argv[1])
    turning = Model(folder, "turning", rotation=True)
    rayleigh = Model(folder, "rayleigh", alpha=(4.0, 7.0), beta=(3e-7, 1e-7))
    both = Model(folder, "both", alpha=(0.0, 5.0), beta=(2e-7, 0.0), rotation=True, contact_damping=3.0)
    modal = Model(folder, "modal", ratios=(0.004, [0.0, 0.01, 0.002, 0.003, 0.008]), contact_damping=1.0)
    modal_turning = Model(folder, "modal-turning", ratios=(None, [0.005] * 30), beta=(1e-7, 0.0), rotation=True)
    power = {"law": "power", "exponent": 2.0, "reference_m": 4e-6}
    rough = {"law": "exponential", "pressure_pa": 2e5, "roughness_m": 1.5e-6, "area_m2": 1e-4}
    opening = Model(folder, "opening", state=State({"law": "linear"}, crowned(2.5e-5), "nodes"))
    crowned_pad = Model(folder, "crowned", contact_damping=2.0, slope=-0.004, lateral=True, grounded=(1.0, 0.0, 1.0), state=State(power, crowned(1.5e-5), "table", "contact-force"))
    rough_pad = Model(folder, "rough", alpha=(4.0, 7.0), rotation=True, contact_damping=2.0, state=State(rough, crowned(2e-6), "vector"))
    models = {
        "opening": opening.told([(500.0, 13.0, 0.0), (500.0, 13.0, 0.4), (2000.0, -13.0, 0.3)]),
        "crowned": crowned_pad.told([(50.0, 13.0, 0.4), (500.0, 13.0, 0.0), (2000.0, 13.0, 0.5)]),
        "rough": rough_pad.told([(100.0, 13.0, 0.4), (1500.0, -30.0, 0.3)]),
        "modal": modal.told([(500.0, 13.0, 0.0), (500.0, 13.0, 0.4)]),
        "modal-turning": modal_turning.told([(500.0, -20.0, 0.3)]),
        "turning": turning.told([(500.0, 0.0, 0.3), (500.0, 13.0, 0.4), (500.0, -13.0, 0.4), (0.0, 60.0, 0.4), (500.0, 60.0, 0.2)]),
        "rayleigh": rayleigh.told([(500.0, 13.0, 0.0), (500.0, 13.0, 0.4)]),
        "both": both.told([(500.0, 13.0, 0.4), (500.0, 37.0, 0.25)]),
    }
    print(json.dumps({"scipy": scipy.__version__, "models": models}))


main()
