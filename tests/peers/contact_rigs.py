#!/usr/bin/env python3
"""Steady sliding of inline rigs with [contact_state], and the roots about it, by numpy and scipy.

    contact_rigs.py CASES.json

reads rig files (TOML text) and conditions, and prints one JSON object: versions, and for every case the contact forces and
the roots. Everything is in the coordinates of the rig file: the statics are solved for the closures, continued from
friction coefficient 0, and the roots are LAPACK's of the matrices there. Nothing of squealcast is used.

    delta + h + B_n K0^-1 (F p + (B_n + x B_t)^T N(delta)) = 0
    K = K0 + (B_n + x B_t)^T diag(dN/ddelta) B_n,   C = C0 + (B_n + x B_t)^T diag(c dN/ddelta / k) B_n
"""

import json
import platform
import sys
import tomllib

import numpy as np
import scipy
import scipy.linalg
import scipy.optimize

STEPS = 10


def law(table, factor, delta):
    """Force and tangent stiffness of each pair."""
    if table["law"] == "linear":
        return factor * np.maximum(delta, 0.0), factor * (delta > 0)
    if table["law"] == "exponential":
        sigma = table["roughness_m"]
        force = factor * table["pressure_pa"] * np.exp(np.minimum(delta / sigma, 300.0))
        return force, force / sigma
    d, m, sigma = table["reference_m"], table["exponent"], table.get("roughness_m", 0.0)
    closure = np.maximum(delta, 0.0) if sigma == 0 else sigma * np.logaddexp(0.0, delta / sigma)
    slope = (delta > 0) if sigma == 0 else scipy.special.expit(delta / sigma)
    return factor * d * (closure / d) ** m, factor * m * (closure / d) ** (m - 1) * slope


class Rig:
    def __init__(self, text):
        rig = tomllib.loads(text)
        pad, disc, pairs = rig["pad"], rig["disc"], rig["contact"]
        block = lambda key: scipy.linalg.block_diag(pad[key], disc[key])
        self.mass, self.stiffness = block("mass"), block("stiffness")
        rows = lambda along: np.array([pair["pad_" + along] + [-v for v in pair["disc_" + along]] for pair in pairs])
        self.normal, self.sliding = rows("normal"), rows("sliding")
        self.table = rig["contact_state"]
        self.load = np.array(self.table["load_pad"] + [0.0] * len(disc["mass"]))
        count = len(pairs)
        self.k = np.array([pair.get("stiffness_n_per_m", 0.0) for pair in pairs])
        self.c = np.array([pair.get("damping_n_s_per_m", 0.0) for pair in pairs])
        self.factor = np.broadcast_to(self.table["area_m2"], count) if "area_m2" in self.table else self.k
        self.gaps = np.broadcast_to(self.table.get("gap_m", 0.0), count).astype(float)
        self.damping = scipy.linalg.block_diag(*[self.modal(part) for part in (pad, disc)])

    @staticmethod
    def modal(part):
        """C = M Phi diag(2 zeta omega) Phi^T M of one part."""
        mass = np.array(part["mass"])
        squares, modes = scipy.linalg.eigh(part["stiffness"], mass)
        zeta = np.broadcast_to(part.get("damping_ratio", 0.0), len(mass))
        weighted = mass @ modes
        return weighted @ np.diag(2 * zeta * np.sqrt(np.maximum(squares, 0.0))) @ weighted.T

    def state(self, load, x):
        """Closures of the pairs."""
        contact = self.table["measured"] == "contact-force"
        count = len(self.gaps)
        solved = np.linalg.solve(self.stiffness, np.column_stack([self.load, self.normal.T, self.sliding.T]))
        per_load, flexibility, skewed = np.split(self.normal @ solved, [1, 1 + count], axis=1)
        # Every pair at the mean force, to begin with.
        share = lambda delta: law(self.table, self.factor, np.full(count, delta))[0].sum() / load - 1.0
        unit = 1e-6
        unknowns = np.append(np.full(count, scipy.optimize.brentq(share, -1e-4, 1e-4) / unit), 1.0)
        for step in range(STEPS + 1):
            g = flexibility + x * step / STEPS * skewed

            def residual(unknowns):
                force, tangent = law(self.table, self.factor, unit * unknowns[:count])
                gaps = self.gaps + unknowns[count] * load * per_load[:, 0]
                balance = unknowns[:count] + (gaps + g @ force) / unit
                slope = np.hstack([np.eye(count) + g * tangent, load * per_load / unit])
                last = force.sum() / load - 1.0 if contact else unknowns[count] - 1.0
                row = np.append(tangent * unit / load, 0.0) if contact else np.append(np.zeros(count), 1.0)
                return np.append(balance, last), np.vstack([slope, row])

            found = scipy.optimize.root(residual, unknowns, jac=True, method="hybr", options={"xtol": 1e-14})
            unknowns = found.x
            # Powell's method stops short of rounding.
            for _ in range(20):
                value, slope = residual(unknowns)
                unknowns = unknowns - np.linalg.solve(slope, value)
            off = np.abs(residual(unknowns)[0]).max()
            assert off < 1e-9, f"statics are off by {off:.1e} at step {step} of {self.table}"
        return unit * unknowns[:count]

    def predict(self, load, speed, mu):
        x = np.sign(speed) * mu
        delta = self.state(load, x)
        force, tangent = law(self.table, self.factor, delta)
        push = self.normal + x * self.sliding
        relaxation = np.divide(self.c, self.k, out=np.zeros_like(self.c), where=self.c > 0)
        stiffness = self.stiffness + push.T @ (tangent[:, None] * self.normal)
        damping = self.damping + push.T @ ((relaxation * tangent)[:, None] * self.normal)
        n = len(self.load)
        scale = 1e4
        flexible = np.linalg.inv(self.mass)
        matrix = np.block([[np.zeros((n, n)), scale * np.eye(n)], [-flexible @ stiffness / scale, -flexible @ damping]])
        roots = scipy.linalg.eigvals(matrix)
        roots = roots[roots.imag > 1.0]
        return {"force_n": force.tolist(), "roots": [[float(z.real), float(z.imag)] for z in roots]}


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        cases = json.load(file)
    found = [Rig(case["rig"]).predict(case["load"], case["speed"], case["mu"]) for case in cases]
    versions = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__}
    print(json.dumps({"versions": versions, "cases": found}))


if __name__ == "__main__":
    main()
