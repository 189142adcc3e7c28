#!/usr/bin/env python3
"""Rigs written by numpy and scipy, and their predictions by scipy.

    scipy_rigs.py DIR

writes rig files of kind 2 (modal substructures) and kind 3 (systems of matrices) into DIR and prints one JSON object:
versions of the programs and, for every case, conditions and expected roots. Everything is assembled here from the
formulas of the method, with scipy's Delaunay triangulation and LAPACK's eigenvalues; nothing of squealcast is used.

    q'' + C q' + K q = 0
    K = diag(W^2) + k(N) (Bn + mu Bt)^T Kc Bn,                       k(N) = (N / N_ref)^alpha
    C = diag(2 zeta W) + (Bn + mu Bt)^T Cc Bn + mu' Bt^T diag(N0) Bt + mu Bb^T diag(N0 / v) Bb
    Bn = [n.Phi_p, -T n.Phi_d], Bt along t, Bb along b = n x t; t = +-(axis x r) / |axis x r|, v = |w| |axis x r|
"""

import functools
import json
import platform
import sys
from pathlib import Path

import numpy as np
import scipy
from scipy.io import mmwrite
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

TAU = 2 * np.pi

# Negative friction coefficients represent sliding in the other direction.
LIMITS = "[limits]\nfriction_coefficient = [-10.0, 10.0]\n"


# --- roots ------------------------------------------------------------------------------------------------------------


def roots(stiffness, damping, pad_modes):
    """Modes (growth, angular frequency, pad share) and growths of the roots that do not oscillate."""
    n = len(stiffness)
    if not damping.any():
        kappa, shapes = scipy.linalg.eig(stiffness)
        found = np.sqrt((-kappa).astype(complex))
        found = np.where(found.imag < 0, -found, found)
        statics = [sign * root.real for root in found if is_static(root) for sign in (1, -1)]
    else:
        # One scale for all coordinates; LAPACK balances the rest.
        scale = np.sqrt(np.abs(np.diag(stiffness)).max())
        state = np.block([[np.zeros((n, n)), scale * np.eye(n)], [-stiffness / scale, -damping]])
        found, vectors = scipy.linalg.eig(state)
        shapes = vectors[:n]
        statics = [root.real for root in found if is_static(root)]
    modes = []
    for k, root in enumerate(found):
        if root.imag > 0 and not is_static(root):
            share = np.abs(shapes[:, k]) ** 2
            pad = None if pad_modes is None else float(share[:pad_modes].sum() / share.sum())
            modes.append([float(root.real), float(root.imag), pad])
    return sorted(modes, key=lambda mode: mode[1]), sorted((float(s) for s in statics), reverse=True)


def is_static(root):
    return abs(root.imag) <= 1e-9 * abs(root)


def case(rig, conditions, matrices, pad_modes, merging=False):
    """One prediction: `conditions` are load in N, speed in rad/s, friction coefficient."""
    stiffness, damping = matrices(*conditions)
    modes, statics = roots(stiffness, damping, pad_modes)
    load, speed, mu = conditions
    growing = [(re, abs(complex(re, im))) for re, im, _ in modes] + [(s, abs(s)) for s in statics]
    return {
        "rig": str(rig),
        "normal_load_n": load,
        "disc_speed_rad_s": speed,
        "friction_coefficient": mu,
        "damped": bool(damping.any()),
        "merging": merging,
        "modes": modes,
        "statics": statics,
        # Not counted at a merging, where scipy too is at the mercy of rounding.
        "unstable": None if merging else sum(re > 1e-6 * size for re, size in growing),
    }


def merging_point(matrices, load, speed, to):
    """The first friction coefficient at which two undamped modes merge, to the last bit."""

    def complex_pairs(mu):
        kappa = scipy.linalg.eigvals(matrices(load, speed, mu)[0])
        return int((np.abs(kappa.imag) > 1e-12 * np.abs(kappa)).sum())

    grid = np.linspace(0, to, 2001)
    for low, high in zip(grid, grid[1:]):
        if complex_pairs(high) > complex_pairs(low):
            while low < 0.5 * (low + high) < high:
                middle = 0.5 * (low + high)
                low, high = (middle, high) if complex_pairs(middle) == complex_pairs(grid[0]) else (low, middle)
            return float(high)
    raise SystemExit(f"no merging up to {to}: another seed is needed")


# --- kind 2 -----------------------------------------------------------------------------------------------------------


class Side:
    """A substructure: frequencies, shapes at its nodes, damping ratios."""

    def __init__(self, rng, nodes, modes, hz, damped, free=0):
        self.nodes = nodes
        self.omega = TAU * rng.permutation(np.linspace(*hz, modes) * rng.uniform(0.97, 1.03, modes))
        self.omega[:free] = 0.0
        self.phi = rng.normal(size=(len(nodes), 3, modes))
        self.zeta = rng.uniform(1e-3, 2e-2, modes) if damped else np.zeros(modes)

    def along(self, node_weights, direction):
        """Displacement along `direction` of a weighted set of nodes, per mode."""
        return sum(weight * (direction @ self.phi[node]) for node, weight in node_weights)

    def lowest(self, count):
        keep = np.argsort(self.omega)[:count]
        self.omega, self.phi, self.zeta = self.omega[keep], self.phi[:, :, keep], self.zeta[keep]


def linear_weights(disc, candidates, at, normal):
    """Weights of the Delaunay triangle of the candidate nodes around a point, seen along the normal; one node where
    it is at the point."""
    distance = np.linalg.norm(disc[candidates] - at, axis=1)
    if distance.min() < 1e-9:
        return [(candidates[int(distance.argmin())], 1.0)]
    across = scipy.linalg.null_space(normal[None, :])
    triangles = Delaunay(disc[candidates] @ across)
    triangle = int(triangles.find_simplex(at @ across))
    assert triangle >= 0, "a pad node outside the disc's surface"
    first = triangles.transform[triangle, :2] @ (at @ across - triangles.transform[triangle, 2])
    weights = [*first, 1 - first.sum()]
    return [(candidates[int(i)], float(w)) for i, w in zip(triangles.simplices[triangle], weights)]


class Modal:
    """A rig of kind 2, and its matrices from the formulas above."""

    def __init__(self, name, pad, disc, patches, slope=0.0, lateral=False, exponent=0.0, reference=500.0, falls=None):
        self.name, self.pad, self.disc, self.patches = name, pad, disc, patches
        self.slope, self.lateral, self.exponent, self.reference = slope, lateral, exponent, reference
        self.falls = falls  # fall of the friction coefficient, speed in m/s and exponent of the Stribeck law

    def write(self, folder, write_pad, modes=""):
        write_pad(folder / f"{self.name}-pad.npz", omega_rad_s=self.pad.omega, phi=self.pad.phi,
                  nodes_m=self.pad.nodes, damping_ratio=self.pad.zeta)  # fmt: skip
        text = f"name = '{self.name}'\n{LIMITS}[pad]\nmodal = '{self.name}-pad.npz'\n{modes}"
        if self.disc is not None:
            # Fortran order here, C order above; the damping ratios in the rig file, which counts modes upwards in
            # frequency, for any order in the archive.
            zeta = self.disc.zeta[np.argsort(self.disc.omega)]
            np.savez_compressed(folder / f"{self.name}-disc.npz", omega_rad_s=self.disc.omega,
                                phi=np.asfortranarray(self.disc.phi), nodes_m=self.disc.nodes)  # fmt: skip
            text += f"[disc]\nmodal = '{self.name}-disc.npz'\ndamping_ratio = {zeta.tolist()}\n"
        text += f"[friction]\nslope_s_per_m = {self.slope!r}\nlateral_damping = {str(self.lateral).lower()}\n"
        if self.falls:
            text += "stribeck_drop = {!r}\nstribeck_speed_m_s = {!r}\nstribeck_exponent = {!r}\n".format(*self.falls)
        text += f"[load]\nexponent = {self.exponent!r}\nreference_n = {self.reference!r}\n"
        for patch in self.patches:
            text += "[[contact_patch]]\n"
            for key in ("axis_point_m", "axis_direction", "normal", "stiffness_n_per_m", "damping_n_s_per_m"):
                value = patch[key]
                text += f"{key} = {value.tolist() if isinstance(value, np.ndarray) else value}\n"
            if "pad_nodes" in patch:
                text += f"pad_nodes = {patch['pad_nodes']}\n"
        path = folder / f"{self.name}.toml"
        path.write_text(text)
        return path

    @functools.cache
    def contact(self, turns):
        """Bn, Bt, Bb, contact stiffness and damping, radii; the disc turns right-handed (1) or left-handed (-1)."""
        pad, disc = self.pad, self.disc
        rows, stiffness, contact_damping, radius = {"n": [], "t": [], "b": []}, [], [], []
        for patch in self.patches:
            axis = patch["axis_direction"] / np.linalg.norm(patch["axis_direction"])
            normal = patch["normal"] / np.linalg.norm(patch["normal"])
            selected = patch.get("pad_nodes", range(len(pad.nodes)))
            stiffness += np.broadcast_to(patch["stiffness_n_per_m"], len(selected)).tolist()
            contact_damping += np.broadcast_to(patch["damping_n_s_per_m"], len(selected)).tolist()
            for node in selected:
                at = pad.nodes[node]
                moving = np.cross(axis, at - patch["axis_point_m"])
                radius.append(np.linalg.norm(moving))
                sliding = turns * moving / radius[-1]
                for key, direction in (("n", normal), ("t", sliding), ("b", np.cross(normal, sliding))):
                    row = [pad.along([(node, 1.0)], direction)]
                    if disc is not None:
                        row.append(-disc.along(linear_weights(disc.nodes, patch["disc_nodes"], at, normal), direction))
                    rows[key].append(np.concatenate(row))
        return [np.array(x) for x in (rows["n"], rows["t"], rows["b"], stiffness, contact_damping, radius)]

    def matrices(self, load, speed, mu):
        pad, disc = self.pad, self.disc
        bn, bt, bb, stiffness, contact_damping, radius = self.contact(1 if speed > 0 else -1)
        omega = np.concatenate([pad.omega] + ([] if disc is None else [disc.omega]))
        zeta = np.concatenate([pad.zeta] + ([] if disc is None else [disc.zeta]))
        k, c = np.diag(omega**2), np.diag(2 * zeta * omega)
        if load <= 0:  # the contact is open
            return k, c
        slides = abs(speed) >= 0.01
        mu = mu if slides else 0.0
        pairs = len(bn)
        n0 = load / pairs
        kc = stiffness * (load / self.reference) ** self.exponent
        k = k + (bn + mu * bt).T @ np.diag(kc) @ bn
        c = c + (bn + mu * bt).T @ np.diag(contact_damping) @ bn
        if slides:
            slope = np.full(pairs, self.slope)
            if self.falls:
                drop, scale, exponent = self.falls
                v = abs(speed) * radius
                slope -= drop * exponent / v * (v / scale) ** exponent * np.exp(-((v / scale) ** exponent))
            c = c + n0 * bt.T @ np.diag(slope) @ bt
            if self.lateral:
                c = c + mu * bb.T @ np.diag(n0 / (abs(speed) * radius)) @ bb
        return k, c


def sector(rng, radii, angles, height, jitter):
    """Nodes on a sector of a ring, a little off their grid."""
    radius, angle = np.meshgrid(radii, angles, indexing="ij")
    radius, angle = (x.ravel() + jitter * rng.uniform(-1, 1, x.size) * s for x, s in ((radius, 2e-3), (angle, 2e-2)))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(radius.size, height)])


def modal_cases(folder):
    rng = np.random.default_rng(20240601)
    turned = Rotation.from_rotvec([0.4, -0.7, 0.3])
    origin = np.array([0.2, -0.1, 0.05])
    axis = turned.apply([0.0, 0.0, 1.0])

    def place(nodes):
        return turned.apply(nodes) + origin

    def patch(normal, disc_nodes, stiffness, damping, **more):
        # A point anywhere on the axis and a direction of any length will do.
        return {"axis_point_m": origin + 0.3 * axis, "axis_direction": 2.5 * axis, "normal": 0.7 * normal,
                "disc_nodes": disc_nodes, "stiffness_n_per_m": stiffness, "damping_n_s_per_m": damping, **more}  # fmt: skip

    pad_grid = np.linspace(0.09, 0.12, 3), np.linspace(0.1, 0.7, 4)
    disc_grid = np.linspace(0.07, 0.14, 8), np.linspace(-0.1, 0.9, 12)
    rigs = []

    # Coincident nodes in another order, more of them on the disc; a disc that turns freely; damping of every kind.
    pad_nodes = sector(rng, *pad_grid, 0.0, 1.0)
    order = rng.permutation(len(pad_nodes))
    disc_nodes = np.concatenate([pad_nodes[order], sector(rng, [0.13, 0.14], [0.2, 0.5, 0.8], 0.0, 1.0)])
    pad = Side(rng, place(pad_nodes), 6, (700, 6000), damped=True)
    disc = Side(rng, place(disc_nodes), 9, (400, 7000), damped=True, free=1)
    patches = [patch(axis, list(range(len(disc_nodes))), 2e7, 35.0)]
    rigs.append((Modal("coincident", pad, disc, patches, -0.02, True, 1 / 3, 400.0, (0.15, 1.2, 2.0)), np.savez, ""))

    # The same with a normal that leans, as on a cone.
    leaning = axis + turned.apply([0.2, 0.1, 0.0])
    patches = [patch(leaning, list(range(len(disc_nodes))), 3e7, 0.0)]
    rigs.append((Modal("leaning", pad, disc, patches, 0.01, True, falls=(0.3, 0.8, 1.0)), np.savez, ""))

    # Different nodes on both sides, no damping; the five lowest of eight pad modes.
    pad = Side(rng, place(sector(rng, *pad_grid, 0.0, 1.0)), 8, (700, 8000), damped=False)
    disc = Side(rng, place(sector(rng, *disc_grid, 0.0, 1.0)), 10, (400, 7000), damped=False)
    patches = [patch(axis, list(range(len(disc.nodes))), 2e7, 0.0)]
    rigs.append((Modal("apart", pad, disc, patches), np.savez_compressed, "modes = 5\n"))

    # A caliper: pads on both faces of the disc, a value for each pair, everything damped.
    faces = [sector(rng, *pad_grid, height, 1.0) for height in (0.01, -0.01)]
    pad = Side(rng, place(np.concatenate(faces)), 9, (600, 8000), damped=True)
    faces = [sector(rng, *disc_grid, height, 1.0) for height in (-0.01, 0.01)]
    disc = Side(rng, place(np.concatenate(faces)), 12, (400, 7000), damped=True)
    half, quarter = len(disc.nodes) // 2, len(pad.nodes) // 2
    patches = [
        patch(axis, list(range(half, 2 * half)), rng.uniform(1e7, 3e7, quarter), rng.uniform(0, 50, quarter),
              pad_nodes=list(range(quarter))),
        patch(-axis, list(range(half)), rng.uniform(1e7, 3e7, quarter), 20.0,
              pad_nodes=list(range(quarter, 2 * quarter))),
    ]  # fmt: skip
    rigs.append((Modal("caliper", pad, disc, patches, -0.01, True, 1.0, 600.0), np.savez, ""))

    # A rigid disc.
    pad = Side(rng, place(sector(rng, *pad_grid, 0.0, 1.0)), 7, (500, 5000), damped=False)
    rigs.append((Modal("rigid", pad, None, [patch(leaning, None, 2e7, 10.0)], 0.0, False, 0.5), np.savez, ""))

    for rig, write_pad, modes in rigs:
        path = rig.write(folder, write_pad, modes)
        if modes:
            rig.pad.lowest(int(modes.split("=")[1]))
        pad_modes = len(rig.pad.omega)
        conditions = [(load, speed, mu) for load, speed in ((500.0, 13.0), (500.0, -13.0), (2300.0, 170.0), (60.0, -0.4))
                      for mu in (0.0, 0.17, 0.35, 0.8)]  # fmt: skip
        conditions += [(500.0, 0.009, 0.5), (500.0, 0.0, 0.5), (500.0, -0.01, 0.5), (0.0, 13.0, 0.5), (500.0, 13.0, -0.3)]
        for each in conditions:
            yield case(path, each, rig.matrices, pad_modes)
        if rig.name == "apart":
            for speed in (13.0, -13.0):
                mu = merging_point(rig.matrices, 500.0, speed, 2.0)
                yield case(path, (500.0, speed, mu), rig.matrices, pad_modes, merging=True)
                yield case(path, (500.0, speed, mu * (1 + 1e-6)), rig.matrices, pad_modes)


# --- kind 3 -----------------------------------------------------------------------------------------------------------


def symmetric(rng, n, low, high):
    """A positive definite matrix with eigenvalues from `low` to `high`."""
    basis = scipy.linalg.qr(rng.normal(size=(n, n)))[0]
    made = basis @ np.diag(np.geomspace(low, high, n)) @ basis.T
    return 0.5 * (made + made.T)


def write_system(folder, name, mass, damping, stiffness, reference, modes=None):
    """`damping`, `stiffness`: lists of matrix, scale as text, symmetry to write."""
    text = f"name = '{name}'\n[reference]\nnormal_load_n = {reference[0]!r}\ndisc_speed_rad_s = {reference[1]!r}\n"
    text += f"friction_coefficient = {reference[2]!r}\n{LIMITS}[system]\nmass = '{name}-m.mtx'\n"
    text += "" if modes is None else f"modes = {modes}\n"
    mmwrite(folder / f"{name}-m.mtx", scipy.sparse.csr_array(mass), symmetry="symmetric", precision=17)
    for key, terms in (("stiffness", stiffness), ("damping", damping)):
        for index, (matrix, scale, symmetry) in enumerate(terms):
            file = f"{name}-{key}-{index}.mtx"
            mmwrite(folder / file, matrix, symmetry=symmetry, precision=17)
            text += f"[[system.{key}]]\nmatrix = '{file}'\n" + ("" if scale is None else f"scale = '{scale}'\n")
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def dense(matrix):
    return matrix.toarray() if scipy.sparse.issparse(matrix) else np.asarray(matrix, dtype=float)


def system_cases(folder):
    rng = np.random.default_rng(7)
    for name, n, modes in (("system", 13, None), ("projected", 40, 11)):
        mass = symmetric(rng, n, 0.5, 3.0)
        elastic = symmetric(rng, n, 4e6, 9e8)
        loaded = scipy.sparse.random_array((n, n), density=0.2, rng=rng) * 2e6
        loaded = scipy.sparse.coo_array(loaded + loaded.T)
        geometric = rng.integers(-9000, 9000, size=(n, n))
        geometric = geometric + geometric.T
        friction = scipy.sparse.coo_array(scipy.sparse.random_array((n, n), density=0.4, rng=rng) * 4e7)
        gyroscopic = rng.normal(size=(n, n)) * 8
        gyroscopic = gyroscopic - gyroscopic.T
        structural = symmetric(rng, n, 5.0, 60.0)
        rubbing = scipy.sparse.coo_array(scipy.sparse.random_array((n, n), density=0.4, rng=rng) * 30)
        # Each law twice: as text for the rig file, as a function for this script.
        stiffness = [
            (elastic, None, "symmetric", lambda load, speed, mu: 1.0),
            (loaded, "(normal_load_n / 500) ^ 0.5", "symmetric", lambda load, speed, mu: np.sqrt(load / 500)),
            (geometric, "disc_speed_rad_s^2/169 - 1", "symmetric", lambda load, speed, mu: speed**2 / 169 - 1),
            (friction, "friction_coefficient / 0.3", "general", lambda load, speed, mu: mu / 0.3),
        ]
        damping = [
            (gyroscopic, "disc_speed_rad_s", "skew-symmetric", lambda load, speed, mu: speed),
            (structural, "1.5e0", "symmetric", lambda load, speed, mu: 1.5),
            (rubbing, "friction_coefficient*normal_load_n/(10*disc_speed_rad_s+1000)", "general",
             lambda load, speed, mu: mu * load / (10 * speed + 1000)),
        ]  # fmt: skip
        reference = (450.0, 11.0, 0.3)
        for damped in (True, False):
            which = name if damped else f"{name}-undamped"
            terms = damping if damped else []
            path = write_system(folder, which, mass, [t[:3] for t in terms], [t[:3] for t in stiffness], reference, modes)
            if modes is None:
                kept = np.linalg.inv(np.linalg.cholesky(mass)).T
            else:
                # Symmetric terms alone, at the reference point.
                at_rest = sum(law(*reference) * dense(m) for m, _, kind, law in stiffness if kind == "symmetric")
                kept = scipy.linalg.eigh(at_rest, mass, subset_by_index=[0, modes - 1])[1]

            def matrices(load, speed, mu, kept=kept, terms=terms):
                mu = mu if abs(speed) >= 0.01 else 0.0  # no contact that could open, but one that may not slide
                zero = np.zeros((n, n))
                k, c = (sum((law(load, speed, mu) * dense(m) for m, _, _, law in sums), zero) for sums in (stiffness, terms))
                return kept.T @ k @ kept, kept.T @ c @ kept

            for load, speed in ((450.0, 11.0), (500.0, 13.0), (500.0, -13.0), (2000.0, 60.0), (0.0, 13.0), (500.0, 0.0)):
                for mu in (0.0, 0.3, 0.6):
                    yield case(path, (load, speed, mu), matrices, None)


def main():
    folder = Path(sys.argv[1])
    versions = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__}
    print(json.dumps({"versions": versions, "cases": [*modal_cases(folder), *system_cases(folder)]}))


if __name__ == "__main__":
    main()
