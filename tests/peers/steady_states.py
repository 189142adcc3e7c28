#!/usr/bin/env python3
"""Steady sliding and the roots about it, by numpy and scipy.

    steady_states.py CASES.json

reads contact data and conditions and prints one JSON object: versions, and for every case the closed pairs, the contact
forces and the roots. The statics are solved by scipy.optimize, continued from friction coefficient 0; the matrices are
assembled here, over the closed pairs only, and their eigenvalues are LAPACK's. Nothing of squealcast is used.

    delta + h + F a + (G_nn + x G_nt) N(delta) = 0,   G = B_n K0^-1 B^T + R,   a = B_n K0^-1 p
    K = K0 + (B_n + x B_t)^T S^-1 B_n,                S = diag(1/k) + R_nn + x R_nt over the closed pairs
    C = C0 + (B_n + x B_t)^T S^-1 k^-1 c k^-1 S^-1 B_n + mu' B_t^T diag(N) B_t + mu B_b^T diag(N / (|w| r)) B_b
    c = k c_ref / k_ref
"""

import json
import platform
import sys

import numpy as np
import scipy
import scipy.optimize

# Steps of the continuation from friction coefficient 0.
STEPS = 20


def law(kind, delta):
    """Force and tangent stiffness of a pair of factor 1."""
    if kind["law"] == "linear":
        closed = delta > 0
        return np.where(closed, kind["stiffness"] * delta, 0.0), np.where(closed, kind["stiffness"], 0.0)
    if kind["law"] == "exponential":
        force = kind["pressure"] * np.exp(delta / kind["roughness_m"])
        return force, force / kind["roughness_m"]
    k, d, m, sigma = (kind[key] for key in ("stiffness", "reference_m", "exponent", "roughness_m"))
    closure = np.maximum(delta, 0.0) if sigma == 0 else sigma * np.logaddexp(0.0, delta / sigma)
    slope = (delta > 0) if sigma == 0 else scipy.special.expit(delta / sigma)
    return k * d * (closure / d) ** m, k * m * (closure / d) ** (m - 1) * slope


def state(data, load, x):
    """Closures at the load and the signed friction coefficient."""
    omega, normal, sliding = (np.array(data[key]) for key in ("omega", "normal", "sliding"))
    gaps, pressed = np.array(data["gaps_m"]), np.array(data["pressed"])
    soft = normal / omega**2
    given = gaps + load * soft @ pressed
    flexibility = [soft @ rows.T + np.array(data[key]) for rows, key in ((normal, "r_nn"), (sliding, "r_nt"))]
    unit = np.abs(given).max()
    scaled = -0.1 * given / unit
    for step in range(STEPS + 1):
        g = flexibility[0] + x * step / STEPS * flexibility[1]

        def residual(scaled):
            force, stiffness = law(data["law"], unit * scaled)
            return scaled + (given + g @ force) / unit, np.eye(len(gaps)) + g * stiffness

        found = scipy.optimize.root(residual, scaled, jac=True, method="hybr", options={"xtol": 1e-15})
        # Powell's method stops short of rounding.
        scaled = found.x
        for _ in range(5):
            value, slope = residual(scaled)
            scaled = scaled - np.linalg.solve(slope, value)
        off = np.abs(residual(scaled)[0]).max()
        assert off < 1e-13, f"{data['name']}: statics are off by {off:.1e} at step {step}"
    return unit * scaled


def predict(data, load, speed, mu):
    x = np.sign(speed) * mu
    normal, sliding, lateral = (np.array(data[key]) for key in ("normal", "sliding", "lateral"))
    delta = state(data, load, x)
    force, tangent = law(data["law"], delta)
    closed = np.flatnonzero(tangent > 0)
    omega = np.array(data["omega"])
    stiffness, damping = np.diag(omega**2), np.diag(2 * data["damping_ratio"] * omega)
    rows, push = normal[closed], (normal + x * sliding)[closed]
    residual = (np.array(data["r_nn"]) + x * np.array(data["r_nt"]))[np.ix_(closed, closed)]
    inverse = np.linalg.inv(np.diag(1 / tangent[closed]) + residual)
    stiffness = stiffness + push.T @ inverse @ rows
    relaxation = np.array(data["relaxation_s"])[closed]
    damping = damping + push.T @ inverse @ np.diag(relaxation / tangent[closed]) @ inverse @ rows
    slope = np.full(len(force), data["slope_s_per_m"])
    if data["stribeck"]:
        drop, scale, exponent = data["stribeck"]
        ratio = abs(speed) * np.array(data["radius_m"]) / scale
        slope -= drop * exponent / scale * ratio ** (exponent - 1) * np.exp(-(ratio**exponent))
    damping = damping + sliding.T @ np.diag(slope * force) @ sliding
    if data["lateral_damping"]:
        across = mu * force / (abs(speed) * np.array(data["radius_m"]))
        damping = damping + lateral.T @ np.diag(across) @ lateral
    n = len(omega)
    if not damping.any():
        squares = -scipy.linalg.eigvals(stiffness)
    else:
        scale = np.sqrt(np.abs(np.diag(stiffness)).max())
        matrix = np.block([[np.zeros((n, n)), scale * np.eye(n)], [-stiffness / scale, -damping]])
        found = scipy.linalg.eigvals(matrix)
        squares = found[found.imag > 0] ** 2
    return {
        "closed": [int(pair) for pair in closed],
        "force_n": force.tolist(),
        "squares": [[float(z.real), float(z.imag)] for z in squares],
    }


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        cases = json.load(file)
    found = [predict(case["data"], case["load"], case["speed"], case["mu"]) for case in cases]
    versions = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__}
    print(json.dumps({"versions": versions, "cases": found}))


if __name__ == "__main__":
    main()
