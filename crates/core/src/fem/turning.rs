//! Bricks that rotate about an axis, in coordinates fixed in space (an Eulerian description).
//!
//! The velocity of a particle of a body of revolution that rotates with `Ω` is `u_t + Ω D u`, where `D u = (v·∇) u` is the
//! derivative of the Cartesian components of the displacement along the circumference, and `v = a × (x - x_0)` is the
//! velocity of the rotation at 1 rad/s. With shape functions `N`, and the stress `Ω² σ` of the centrifugal load,
//!
//! ```text
//! M ü + 2 Ω H u̇ + (K + Ω² (K_σ - L)) u = 0
//! H = skew ∫ ρ Nᵀ D N dV,   L = ∫ ρ (D N)ᵀ (D N) dV,   K_σ = ∫ (∂_i N)ᵀ σ_ij (∂_j N) dV
//! K u_0 = ∫ ρ Nᵀ r dV,   σ = C ε(u_0)                  r: vector from the axis
//! ```
//!
//! `K_σ` is of the same order as `L`. Without it, a rigid rotation of a free body about the axis would have the stiffness
//! `-Ω² I`, with its moment of inertia `I`; with it, the stiffness vanishes, because `∫ (σ : (1 - a aᵀ)) dV = ∫ ρ r² dV`.
//!
//! Incompatible modes are eliminated in terms of the corner displacements, as in the mass matrix. The skew part of `∫ ρ Nᵀ D N` is taken brick by
//! brick; the symmetric part is a surface integral that vanishes on a closed ring and is a discretisation error on a
//! polygon.

use faer::Mat;

use super::brick::{StressPoint, following, mass_points, stress_points};
use super::structure::{Entry, Structure};
use super::{FemError, Material};
use crate::reduction::{ReductionError, SparseMatrix, balanced_displacement};

/// An axis in space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    /// A point of the axis, m.
    pub point_m: [f64; 3],
    /// Direction, of length 1; the rotation is right-handed about it.
    pub direction: [f64; 3],
}

/// Matrices of a turning structure over its free degrees of freedom, in the rows of
/// [`Assembled`](super::Assembled).
#[derive(Clone, Debug)]
pub struct Turning {
    /// `H`, kg, exactly skew: the force is `2 Ω H u̇`.
    pub gyroscopic: SparseMatrix,
    /// `L`, kg, exactly symmetric: the force is `-Ω² L u`.
    pub spin: SparseMatrix,
    /// `K_σ`, kg, exactly symmetric: the force is `Ω² K_σ u`.
    pub stiffening: SparseMatrix,
}

/// Error of [`Structure::turning`].
#[derive(Clone, Debug, thiserror::Error)]
pub enum TurningError {
    /// The structure has no matrices.
    #[error(transparent)]
    Fem(#[from] FemError),
    /// The centrifugal stress could not be solved for.
    #[error("centrifugal load: {0}")]
    Load(#[from] ReductionError),
}

/// Matrices of one brick: `H`, `L` and the centrifugal load at 1 rad/s.
struct BrickTurning {
    gyroscopic: [[f64; 24]; 24],
    spin: [[f64; 24]; 24],
    /// kg m.
    load: [f64; 24],
}

impl Axis {
    /// Velocity of the rotation at 1 rad/s, m/s: `a × (x - x_0)`.
    fn velocity(&self, at_m: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = [0, 1, 2].map(|axis| at_m[axis] - self.point_m[axis]);
        let [a, b, c] = self.direction;
        [b * z - c * y, c * x - a * z, a * y - b * x]
    }

    /// Vector from the axis to a place, m.
    fn radius(&self, at_m: [f64; 3]) -> [f64; 3] {
        let from = [0, 1, 2].map(|axis| at_m[axis] - self.point_m[axis]);
        let along: f64 = from.iter().zip(self.direction).map(|(x, a)| x * a).sum();
        [0, 1, 2].map(|axis| from[axis] - along * self.direction[axis])
    }
}

impl Structure {
    /// Assembles the matrices of a structure that turns about `axis`. Its springs are fixed in space and do not
    /// contribute.
    ///
    /// # Errors
    /// [`TurningError`]: those of [`Structure::assemble`]; a stiffness matrix with which the centrifugal load cannot be
    /// balanced.
    pub fn turning(&self, axis: &Axis) -> Result<Turning, TurningError> {
        let assembled = self.assemble()?;
        let mut load = Mat::<f64>::zeros(assembled.rows.len(), 1);
        let row_of = self.row_of(&assembled.rows);
        let mut spin = vec![];
        let mut failed = None;
        let gyroscopic = self.assemble_bricks(Entry::Skew, &mut |index| {
            let (nodes_m, material) = self.brick_at(index);
            let of_brick = match brick_turning(&nodes_m, material, axis) {
                Ok(of_brick) => of_brick,
                Err(value) => {
                    failed.get_or_insert(self.inverted(index, value));
                    return [[0.0; 24]; 24];
                }
            };
            for (corner, &node) in self.mesh.bricks[index].nodes.iter().enumerate() {
                for (independent, weight) in self.mesh.weights(node) {
                    for (direction, row) in row_of[independent].iter().enumerate() {
                        if let Some(row) = *row {
                            load[(row, 0)] += weight * of_brick.load[3 * corner + direction];
                        }
                    }
                }
            }
            spin.push(of_brick.spin);
            of_brick.gyroscopic
        })?;
        if let Some(error) = failed {
            return Err(error.into());
        }
        let spin = self.assemble_bricks(Entry::Symmetric, &mut |index| spin[index])?;
        let displacement = balanced_displacement(&assembled.mass, &assembled.stiffness, load)?;
        let stiffening = self.assemble_bricks(Entry::Symmetric, &mut |index| {
            let (nodes_m, material) = self.brick_at(index);
            let mut of_corners = [0.0; 24];
            for (corner, &node) in self.mesh.bricks[index].nodes.iter().enumerate() {
                for (independent, weight) in self.mesh.weights(node) {
                    for (direction, row) in row_of[independent].iter().enumerate() {
                        of_corners[3 * corner + direction] += row.map_or(0.0, |row| weight * displacement[(row, 0)]);
                    }
                }
            }
            brick_stiffening(&nodes_m, material, &of_corners)
        })?;
        Ok(Turning { gyroscopic, spin, stiffening })
    }
}

/// `H`, `L` and the centrifugal load of a brick.
///
/// # Errors
/// The determinant of the Jacobian, m³, if it is not above 0.
fn brick_turning(nodes_m: &[[f64; 3]; 8], material: &Material, axis: &Axis) -> Result<BrickTurning, f64> {
    let follows = following(nodes_m, material)?;
    const SHAPES: usize = super::brick::SHAPES;
    // The three directions have the same matrix over the shape functions.
    let (mut gyroscopic, mut spin) = ([[0.0; SHAPES]; SHAPES], [[0.0; SHAPES]; SHAPES]);
    let mut full_load = [[0.0; 3]; SHAPES];
    for point in mass_points(nodes_m) {
        let at: [f64; 3] =
            std::array::from_fn(|axis| (0..8).map(|corner| point.shapes[corner] * nodes_m[corner][axis]).sum());
        let (velocity, radius) = (axis.velocity(at), axis.radius(at));
        let along: [f64; SHAPES] =
            point.gradients.map(|gradient| gradient.iter().zip(velocity).map(|(slope, v)| slope * v).sum());
        let weight = material.density_kg_per_m3 * point.weight;
        for a in 0..SHAPES {
            (0..3).for_each(|direction| full_load[a][direction] += weight * point.shapes[a] * radius[direction]);
            for b in 0..SHAPES {
                gyroscopic[a][b] += weight * point.shapes[a] * along[b];
                spin[a][b] += weight * along[a] * along[b];
            }
        }
    }
    let (gyroscopic, spin) = (on_corners(&gyroscopic, &follows), on_corners(&spin, &follows));
    let load = std::array::from_fn(|column| {
        (0..3 * SHAPES).map(|row| follows[row][column] * full_load[row / 3][row % 3]).sum()
    });
    Ok(BrickTurning {
        gyroscopic: std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (gyroscopic[i][j] - gyroscopic[j][i]))),
        spin: std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (spin[i][j] + spin[j][i]))),
        load,
    })
}

/// `K_σ` of a brick whose corners have the displacements `of_corners`, m.
fn brick_stiffening(nodes_m: &[[f64; 3]; 8], material: &Material, of_corners: &[f64; 24]) -> [[f64; 24]; 24] {
    const SHAPES: usize = super::brick::SHAPES;
    let (Ok(follows), Ok(points)) = (following(nodes_m, material), stress_points(nodes_m)) else {
        unreachable!("the brick was assembled before");
    };
    let displacement: [f64; 3 * SHAPES] =
        std::array::from_fn(|row| follows[row].iter().zip(of_corners).map(|(weight, u)| weight * u).sum());
    let (lambda, shear) = material.lame_pa();
    let mut full = [[0.0; SHAPES]; SHAPES];
    for StressPoint { weight, gradients } in points {
        // ∂u_d/∂x_i.
        let slope = |d: usize, i: usize| -> f64 {
            (0..SHAPES).map(|shape| displacement[3 * shape + d] * gradients[shape][i]).sum()
        };
        let slopes: [[f64; 3]; 3] = std::array::from_fn(|d| std::array::from_fn(|i| slope(d, i)));
        let trace = slopes[0][0] + slopes[1][1] + slopes[2][2];
        let stress =
            |i: usize, j: usize| shear * (slopes[i][j] + slopes[j][i]) + if i == j { lambda * trace } else { 0.0 };
        let stress: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| stress(i, j)));
        for a in 0..SHAPES {
            let pulled: [f64; 3] = std::array::from_fn(|j| (0..3).map(|i| gradients[a][i] * stress[i][j]).sum());
            for b in 0..SHAPES {
                let along: f64 = pulled.iter().zip(gradients[b]).map(|(force, slope)| force * slope).sum();
                full[a][b] += weight * along;
            }
        }
    }
    let matrix = on_corners(&full, &follows);
    std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (matrix[i][j] + matrix[j][i])))
}

/// `Tᵀ A T`, where `A` is the same `full` matrix over the shape functions for each direction.
fn on_corners<const S: usize>(full: &[[f64; S]; S], follows: &[[f64; 24]]) -> [[f64; 24]; 24] {
    let mut half = vec![[0.0; 24]; 3 * S];
    for (a, row) in full.iter().enumerate() {
        for (b, value) in row.iter().enumerate() {
            for direction in 0..3 {
                for (sum, weight) in half[3 * a + direction].iter_mut().zip(&follows[3 * b + direction]) {
                    *sum += value * weight;
                }
            }
        }
    }
    let mut matrix = [[0.0; 24]; 24];
    for (row, weights) in half.iter().zip(follows) {
        for (sums, weight) in matrix.iter_mut().zip(weights) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += weight * value;
            }
        }
    }
    matrix
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use faer::MatRef;

    use super::*;
    use crate::fem::{Assembled, Extent, Mesh, stations};

    const STEEL: Material = Material { density_kg_per_m3: 7800.0, young_pa: 210e9, poisson: 0.3 };
    const AXIS: Axis = Axis { point_m: [0.0; 3], direction: [0.0, 1.0, 0.0] };

    /// A free ring about the y axis: 0.05 to 0.12 m, `thick` thick, with `around` bricks along the circumference.
    fn ring(thick: f64, radial: usize, around: usize) -> Structure {
        let mut mesh = Mesh::default();
        let steel = mesh.add_component("ring", STEEL);
        let angles = stations(&[0.0, TAU], TAU / around as f64);
        let lines = [stations(&[0.05, 0.12], 0.07 / radial as f64), vec![-0.5 * thick, 0.5 * thick], angles];
        let closed = Extent { filled: &|_| true, closed: true };
        // The rotation is right-handed about y: from z to x.
        mesh.add_block(steel, lines, closed, &[], |[r, y, angle]| [r * angle.cos(), y, r * angle.sin()]);
        Structure { mesh, ..Structure::default() }
    }

    /// A displacement field at every row.
    fn field(structure: &Structure, rows: &[(usize, usize)], u: impl Fn([f64; 3]) -> [f64; 3]) -> Mat<f64> {
        Mat::from_fn(rows.len(), 1, |row, _| u(structure.mesh.nodes_m[rows[row].0])[rows[row].1])
    }

    fn form(a: &Mat<f64>, matrix: &SparseMatrix, b: &Mat<f64>) -> f64 {
        (a.transpose() * matrix * b)[(0, 0)]
    }

    fn exact_mirror(matrix: &SparseMatrix, sign: f64) -> bool {
        let view = matrix.as_ref();
        view.triplet_iter()
            .all(|entry| view.get(entry.col, entry.row).is_some_and(|mirrored| *mirrored == sign * *entry.val))
    }

    /// On linear displacement fields, which bricks represent exactly, the forms follow from the mass and the moments of
    /// inertia of the polygonal ring, which the mass matrix has too.
    #[test]
    fn linear_motions_have_their_exact_forms_and_rigid_rotations_no_stiffness() {
        let structure = ring(0.02, 3, 24);
        let Assembled { mass, stiffness, rows } = structure.assemble().unwrap();
        let Turning { gyroscopic, spin, stiffening } = structure.turning(&AXIS).unwrap();
        assert!(exact_mirror(&gyroscopic, -1.0) && exact_mirror(&spin, 1.0) && exact_mirror(&stiffening, 1.0));
        let along = |direction: usize| {
            field(&structure, &rows, |_| std::array::from_fn(|d| if d == direction { 1.0 } else { 0.0 }))
        };
        let turn = field(&structure, &rows, |[x, _, z]| [z, 0.0, -x]);
        let outward = field(&structure, &rows, |[x, _, z]| [x, 0.0, z]);
        // A translation does not change along the circumference.
        let total = form(&along(0), &mass, &along(0));
        assert!(form(&along(0), &spin, &along(0)).abs() < 1e-12 * total);
        // A rigid rotation `a × x`: D u = a × (a × x), the inward radius.
        let inertia = form(&turn, &mass, &turn);
        assert!((form(&turn, &spin, &turn) / inertia - 1.0).abs() < 1e-12);
        // `D` maps radial motion to rotation, D r = a × r, and rotation to inward motion.
        assert!((form(&turn, &gyroscopic, &outward) / inertia - 1.0).abs() < 1e-12);
        // The stress of the centrifugal load cancels the spin term of a rigid rotation: ∫ σ:(1 - a aᵀ) = ∫ ρ r². Limited by
        // the displacement, which settles to 1e-12 of its largest entry and passes through K.
        let rigid = form(&turn, &stiffening, &turn);
        assert!((rigid / inertia - 1.0).abs() < 1e-9, "{}", rigid / inertia - 1.0);
        // A tilt about a diameter has no stiffness either: in the frame of the pad, a free gyroscope has none.
        let tilt = field(&structure, &rows, |[_, y, z]| [0.0, -z, y]);
        let (felt, spun) = (form(&tilt, &stiffening, &tilt), form(&tilt, &spin, &tilt));
        assert!((spun / (0.5 * inertia) - 1.0).abs() < 1e-12 && (felt / spun - 1.0).abs() < 1e-9, "{felt} {spun}");
        let forces = &stiffness * &turn;
        assert!(forces.norm_max() < 1e-9 * stiffness.val().iter().fold(0.0, |m: f64, k| m.max(k.abs())));
    }

    /// All roots `λ` with `ω > 0` of `λ² M + 2 Ω λ H + K - Ω² L`, ascending in frequency, by a dense solve.
    fn frequencies([mass, stiffness, gyroscopic, spin]: [MatRef<'_, f64>; 4], speed: f64) -> Vec<faer::c64> {
        let n = mass.nrows();
        let solver = {
            use faer::linalg::solvers::Solve;
            let llt = mass.llt(faer::Side::Lower).unwrap();
            let k = Mat::from_fn(n, n, |i, j| stiffness[(i, j)] - speed * speed * spin[(i, j)]);
            let g = Mat::from_fn(n, n, |i, j| 2.0 * speed * gyroscopic[(i, j)]);
            (llt.solve(&k), llt.solve(&g))
        };
        let (k, g) = solver;
        // Velocities divided by a typical frequency, so that both halves have the same size.
        let unit = (0..n).map(|i| k[(i, i)]).fold(0.0, f64::max).sqrt();
        let state = Mat::from_fn(2 * n, 2 * n, |i, j| match (i < n, j < n) {
            (true, true) => 0.0,
            (true, false) => {
                if j - n == i {
                    1.0
                } else {
                    0.0
                }
            }
            (false, true) => -k[(i - n, j)] / (unit * unit),
            (false, false) => -g[(i - n, j - n)] / unit,
        });
        let mut roots: Vec<faer::c64> =
            state.eigenvalues().unwrap().into_iter().map(|root| root * unit).filter(|root| root.im > 0.0).collect();
        roots.sort_by(|a, b| a.im.total_cmp(&b.im));
        roots
    }

    /// Dense matrices of a ring whose nodes move along the axis only: transverse motion alone.
    fn transverse(radial: usize, around: usize) -> [Mat<f64>; 4] {
        let mut structure = ring(0.01, radial, around);
        let nodes = structure.mesh.nodes_m.len();
        structure.fixed.extend((0..nodes).flat_map(|node| [(node, 0), (node, 2)]));
        let Assembled { mass, stiffness, .. } = structure.assemble().unwrap();
        let Turning { gyroscopic, spin, .. } = structure.turning(&AXIS).unwrap();
        [mass, stiffness, gyroscopic, spin].map(|matrix| matrix.to_dense())
    }

    fn views(matrices: &[Mat<f64>; 4]) -> [MatRef<'_, f64>; 4] {
        std::array::from_fn(|k| matrices[k].as_ref())
    }

    /// Transverse motion with `m` nodal diameters splits into travelling waves at exactly `ω_0 ± m Ω` in the continuum.
    /// On the mesh, the difference falls with the square of the spacing.
    #[test]
    fn transverse_waves_travel_at_omega_plus_and_minus_m_times_the_speed() {
        let speed = 200.0;
        let errors = [12, 24].map(|around| {
            let matrices = transverse(2, around);
            let (rest, turning) = (frequencies(views(&matrices), 0.0), frequencies(views(&matrices), speed));
            // All eigenvalues are imaginary below the critical speed.
            assert!(turning.iter().all(|root| root.re.abs() < 1e-9 * turning[turning.len() - 1].norm()));
            // Without supports, m = 0 moves as a rigid body at 0 rad/s; then come the pairs m = 1, 2, 3.
            let rest: Vec<f64> = rest.iter().map(|root| root.im).filter(|omega| *omega > 100.0).collect();
            let mut expected: Vec<f64> = (1..=3)
                .flat_map(|m| {
                    let omega = rest[2 * m - 2];
                    assert!((rest[2 * m - 1] / omega - 1.0).abs() < 1e-6, "a pair: {omega}");
                    [omega - m as f64 * speed, omega + m as f64 * speed]
                })
                .collect();
            expected.sort_by(f64::total_cmp);
            let found: Vec<f64> = turning.iter().map(|root| root.im).filter(|omega| *omega > 100.0).collect();
            expected.iter().zip(&found).map(|(expected, found)| (found - expected).abs() / speed).fold(0.0, f64::max)
        });
        eprintln!("errors of the split in parts of the speed: {errors:?}");
        assert!(errors[1] < 0.35 * errors[0] && errors[1] < 0.05, "{errors:?}");
    }

    /// A thin free disc in all directions, on its lowest modes. A transverse mode with `m` nodal diameters has the form
    /// `φᵀ L φ = m²` and splits to `ω_0 ± m Ω`; where the slower wave is stationary, `Ω = ω_0 / m`, the disc without its
    /// stress becomes unstable. In-plane motion of the faces changes this by about `(thickness / radius)²`, 3e-4, and the
    /// mesh by `(m spacing)² / 12`.
    #[test]
    fn the_backward_wave_of_a_thin_disc_has_zero_frequency_at_its_critical_speed() {
        let structure = ring(0.002, 3, 48);
        let Assembled { mass, stiffness, .. } = structure.assemble().unwrap();
        let Turning { gyroscopic, spin, stiffening } = structure.turning(&AXIS).unwrap();
        let modes = crate::reduction::lowest_modes("disc", &mass, &stiffness, 20).unwrap();
        let phi = modes.phi.subcols(6, 14);
        let on_modes = |matrix: &SparseMatrix| phi.transpose() * matrix * phi;
        let [h, l, s] = [&gyroscopic, &spin, &stiffening].map(on_modes);
        let squares = Mat::from_fn(14, 14, |i, j| if i == j { modes.omega_squared[6 + i] } else { 0.0 });
        let unit = Mat::<f64>::identity(14, 14);
        // The lowest pair has two nodal diameters.
        let (omega, m) = (squares[(0, 0)].sqrt(), l[(0, 0)].sqrt());
        assert!((m - 2.0).abs() < 0.02, "{m} nodal diameters at {omega} rad/s");
        let views = |spin: &Mat<f64>, speed: f64| {
            frequencies([unit.as_ref(), squares.as_ref(), h.as_ref(), spin.as_ref()], speed)
        };
        let split = views(&l, 60.0);
        for (root, expected) in split.iter().zip([omega - 120.0, omega + 120.0]) {
            assert!((root.im - expected).abs() < 0.01 * 120.0 && root.re.abs() < 1e-9 * omega, "{root} {expected}");
        }
        // `K - Ω² L` becomes indefinite at the critical speed of one of the waves.
        let definite = |speed: f64, spin: &Mat<f64>| {
            let k = Mat::from_fn(14, 14, |i, j| squares[(i, j)] - 0.5 * speed * speed * (spin[(i, j)] + spin[(j, i)]));
            k.llt(faer::Side::Lower).is_ok()
        };
        let expected = (0..14).map(|k| (squares[(k, k)] / l[(k, k)]).sqrt()).fold(f64::INFINITY, f64::min);
        assert!(definite(0.99 * expected, &l) && !definite(1.01 * expected, &l));
        let below = views(&l, 0.98 * expected);
        assert!(below.iter().all(|root| root.re.abs() < 1e-8 * root.im));
        // The stress of the centrifugal load keeps a turning disc stable beyond that speed.
        let carried = &l - &s;
        assert!(definite(1.01 * expected, &carried));
        eprintln!("{omega:.1} rad/s with {m:.4} nodal diameters, critical at {expected:.1} rad/s");
    }
}
