"""Against LAPACK by scipy: on the matrices of the rig, and on matrices put together here from the rig file."""

import math

import numpy as np
import pytest
import squealcast
from conftest import ROOT

linalg = pytest.importorskip("scipy.linalg")
tomllib = pytest.importorskip("tomllib")


def roots(stiffness, damping):
    """Roots of (λ² I + λ C + K) x = 0 with ω > 0."""
    n = len(stiffness)
    if not damping.any():
        values = np.sqrt(linalg.eigvals(-stiffness).astype(complex))
    else:
        scale = math.sqrt(np.linalg.norm(stiffness))
        state = np.block([[np.zeros((n, n)), scale * np.eye(n)], [-stiffness / scale, -damping]])
        values = linalg.eigvals(state)
    values = np.where(values.imag < 0.0, -values, values) if not damping.any() else values[values.imag > 0.0]
    return np.sort_complex(values[values.imag > 1e-6])


@pytest.mark.parametrize("name", ["tribometer", "tribometer-80+80", "tribometer-lining", "nine-dof-case-2", "rough-pad"])
def test_roots_of_the_rig_s_matrices(name):
    rig = squealcast.Rig.load(name)
    for mu in (0.1, 0.35):
        stiffness, damping = rig.matrices(mu=mu)
        found = rig.predict(mu=mu)
        theirs = roots(stiffness, damping)
        assert len(found.eigenvalue_per_s) > 2
        # Squares, since a root that merges with another has half the digits; the bound is LAPACK's backward error.
        limit = 1e3 * np.finfo(float).eps * max(np.linalg.norm(stiffness), np.linalg.norm(damping) ** 2)
        for root in found.eigenvalue_per_s:
            assert np.abs(theirs**2 - root**2).min() < limit + 1e-9 * abs(root) ** 2, (mu, root)


def test_roots_of_the_paper_s_matrices():
    """K(mu) = diag(K_pad, K_disc) + sum k (n + mu t) nᵀ, with the masses of the rig file."""
    file = tomllib.loads((ROOT / "launch/rigs/nine-dof-case-2.toml").read_text())
    pad, disc = file["pad"], file["disc"]
    mass = linalg.block_diag(pad["mass"], disc["mass"])
    parts = linalg.block_diag(pad["stiffness"], disc["stiffness"])
    rig = squealcast.Rig.load("nine-dof-case-2")
    for mu in (0.0, 0.3, 0.7):
        stiffness = parts.copy()
        for contact in file["contact"]:
            normal = np.concatenate([contact["pad_normal"], -np.array(contact["disc_normal"])])
            sliding = np.concatenate([contact["pad_sliding"], -np.array(contact["disc_sliding"])])
            stiffness += contact["stiffness_n_per_m"] * np.outer(normal + mu * sliding, normal)
        squares = np.sort_complex(linalg.eigvals(-stiffness, mass))
        mine = np.sort_complex(rig.predict(mu=mu).eigenvalue_per_s.astype(complex) ** 2)
        # With masses of 0.5 to 2 and springs of 1 to 10 both are exact to some hundred units in the last place.
        assert np.abs(mine.real - squares.real).max() < 1e-8 and np.abs(np.sort(mine.imag) - np.sort(squares.imag)).max() < 1e-7
