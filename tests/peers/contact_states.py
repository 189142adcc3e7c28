"""States of sliding contact by numpy and scipy: random flexibilities, friction coefficients 0 to 0.6. Writes JSON.

Linear law: every set of closed pairs is tried, so the number of states is known. Other laws: scipy.optimize.root, along the
friction coefficient in steps of 0.01 from a start at the mean pressure.
"""

import itertools
import json
import sys

import numpy as np
import scipy
from scipy.optimize import root

MICROMETRE = 1e-6


def problem(rng, pairs, wedge):
    modes = pairs + 3
    square = rng.uniform(1e7, 4e8, modes)
    normal = rng.normal(size=(pairs, modes))
    normal[:, 0] = 1 + 0.2 * rng.normal(size=pairs)
    sliding = wedge * rng.normal(size=(pairs, modes))
    load = np.concatenate([[-1], 0.1 * rng.normal(size=modes - 1)])
    return {
        "normal_flexibility": normal @ np.diag(1 / square) @ normal.T,
        "sliding_flexibility": normal @ np.diag(1 / square) @ sliding.T,
        "gap_per_load": normal @ (load / square),
        "gap_m": 2e-6 * rng.normal(size=pairs),
        "area": rng.uniform(0.5, 1.5, pairs),
        "load_n": rng.uniform(5, 200),
    }


def enumerated(p, mu, stiffness):
    """All states with the law k δ: N of each."""
    g = p["normal_flexibility"] + mu * p["sliding_flexibility"]
    offset = p["gap_m"] + p["load_n"] * p["gap_per_load"]
    k = stiffness * p["area"]
    pairs, states = len(k), []
    for choice in itertools.product([False, True], repeat=pairs):
        closed = np.array(choice)
        force = np.zeros(pairs)
        if closed.any():
            matrix = g[np.ix_(closed, closed)] + np.diag(1 / k[closed])
            force[closed] = np.linalg.solve(matrix, -offset[closed])
        closure = -(offset + g @ force)
        if (force[closed] > 0).all() and (closure[~closed] <= 0).all():
            states.append(force.tolist())
    return states


def laws():
    def power(stiffness, reference, exponent):
        return lambda d: np.where(d > 0, stiffness * reference * (np.maximum(d, 0) / reference) ** exponent, 0)

    def rounded(stiffness, reference, exponent, roughness):
        return lambda d: stiffness * reference * (roughness * np.logaddexp(0, d / roughness) / reference) ** exponent

    def exponential(pressure, roughness):
        return lambda d: pressure * np.exp(np.minimum(d / roughness, 300))

    return [
        ({"power": [2e7, 2e-6, 2.0, 0.0]}, power(2e7, 2e-6, 2.0)),
        ({"power": [2e7, 2e-6, 1.5, 5e-7]}, rounded(2e7, 2e-6, 1.5, 5e-7)),
        ({"power": [2e7, 2e-6, 1.0, 1e-6]}, rounded(2e7, 2e-6, 1.0, 1e-6)),
        ({"exponential": [1.0, 1e-6]}, exponential(1.0, 1e-6)),
    ]


def followed(p, law, last):
    """States at 0, 0.2, .. `last`; ends early where scipy finds none."""
    offset = p["gap_m"] + p["load_n"] * p["gap_per_load"]

    def left(scaled, mu):
        d = scaled * MICROMETRE
        g = p["normal_flexibility"] + mu * p["sliding_flexibility"]
        return (d + offset + g @ (p["area"] * law(d))) / MICROMETRE

    found, scaled = [], np.full(len(offset), 1.0)
    for step in range(round(last / 0.01) + 1):
        mu = 0.01 * step
        answer = root(left, scaled, args=(mu,), method="hybr", options={"xtol": 1e-15, "maxfev": 20000})
        size = np.abs(answer.x).max() + np.abs(offset / MICROMETRE).max()
        if np.abs(left(answer.x, mu)).max() > 1e-11 * size:
            break
        scaled = answer.x
        if step % 20 == 0:
            found.append({"friction": mu, "force": (p["area"] * law(scaled * MICROMETRE)).tolist()})
    return found


def main():
    rng = np.random.default_rng(20261122)
    cases = []
    plain = lambda p: {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in p.items()}
    for number in range(40):
        p = problem(rng, 1 + number % 8, 3.0 if number % 4 == 3 else 0.6)
        states = [
            {"friction": mu, "all": enumerated(p, mu, 2e7)} for mu in [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
        ]
        cases.append({**plain(p), "law": {"linear": [2e7]}, "states": states})
    for number in range(24):
        p = problem(rng, 2 + number % 7, 0.6)
        name, law = laws()[number % 4]
        cases.append({**plain(p), "law": name, "states": followed(p, law, 0.6)})
    versions = f"numpy {np.__version__}, scipy {scipy.__version__}"
    json.dump({"versions": versions, "cases": cases}, sys.stdout)


if __name__ == "__main__":
    main()
