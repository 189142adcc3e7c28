//! The 8-node brick element with incompatible modes.
//!
//! The displacement is trilinear plus `Σ_m (1 - ξ_m²) α_m`, internal modes that let the element bend without parasitic
//! shear. Their gradients use the Jacobian at the centre, scaled by `det J₀ / det J`, so that the patch test (constant
//! strain) holds for distorted bricks. `α` is eliminated by static condensation of the stiffness; the mass is
//! transformed accordingly.
//!
//! Source: Wilson, Taylor, Doherty, Ghaboussi, "Incompatible displacement models", in Numerical and Computer Methods in
//! Structural Mechanics (1973) 43-57; Taylor, Beresford, Wilson, "A non-conforming element for stress analysis", Int.
//! J. Numer. Meth. Engng 10 (1976) 1211-1219.

use super::Material;

/// Natural coordinates `ξ, η, ζ` of the corners, in the node order of Abaqus and CalculiX.
pub(super) const CORNERS: [[f64; 3]; 8] = [
    [-1.0, -1.0, -1.0],
    [1.0, -1.0, -1.0],
    [1.0, 1.0, -1.0],
    [-1.0, 1.0, -1.0],
    [-1.0, -1.0, 1.0],
    [1.0, -1.0, 1.0],
    [1.0, 1.0, 1.0],
    [-1.0, 1.0, 1.0],
];
/// Number of shape functions: 8 nodes and 3 incompatible modes.
pub(super) const SHAPES: usize = 11;

/// Matrices of one brick.
#[derive(Clone, Debug, PartialEq)]
pub struct BrickMatrices {
    /// `K`, N/m; row `3 a + d` is node `a`, direction `d`.
    pub stiffness: [[f64; 24]; 24],
    /// `M`, kg, in the row order of the stiffness.
    pub mass: [[f64; 24]; 24],
}

/// Stiffness and mass of a brick with the corners `nodes_m`, m, in the node order of `C3D8I` of CalculiX. The stiffness
/// is integrated with 2x2x2 Gauss points, the mass with 3x3x3.
///
/// # Errors
/// The determinant of the Jacobian, m³, if it is not above 0: the brick is inverted or too distorted.
pub fn brick(nodes_m: &[[f64; 3]; 8], material: &Material) -> Result<BrickMatrices, f64> {
    let (mut full, mut full_mass) = (full_stiffness(nodes_m, material)?, [[0.0; 3 * SHAPES]; 3 * SHAPES]);
    add_mass(&mut full_mass, nodes_m, material.density_kg_per_m3);
    condense(&mut full, &mut full_mass);
    let outer = |full: &[[f64; 3 * SHAPES]; 3 * SHAPES]| {
        std::array::from_fn(|row| std::array::from_fn(|column| full[row][column]))
    };
    Ok(BrickMatrices { stiffness: outer(&full), mass: outer(&full_mass) })
}

/// Stiffness over corner and incompatible shape functions, integrated with 2x2x2 points.
fn full_stiffness(nodes_m: &[[f64; 3]; 8], material: &Material) -> Result<[[f64; 3 * SHAPES]; 3 * SHAPES], f64> {
    let (lambda, shear) = material.lame_pa();
    let mut full = [[0.0; 3 * SHAPES]; 3 * SHAPES];
    for StressPoint { weight, gradients } in stress_points(nodes_m)? {
        add_stiffness(&mut full, &gradients, lambda, shear, weight);
    }
    Ok(full)
}

/// A point of the 2x2x2 rule at which stresses are computed.
#[derive(Clone, Copy)]
pub(super) struct StressPoint {
    /// Weight, m³.
    pub weight: f64,
    /// Gradients of all shape functions, 1/m. Those of the incompatible modes use the Jacobian at the centre.
    pub gradients: [[f64; 3]; SHAPES],
}

/// The points at which stresses are computed.
///
/// # Errors
/// The determinant of the Jacobian, m³, if it is not above 0.
pub(super) fn stress_points(nodes_m: &[[f64; 3]; 8]) -> Result<[StressPoint; 8], f64> {
    let (centre, centre_det) = inverse(&jacobian(nodes_m, [0.0; 3]));
    if centre_det.is_nan() || centre_det <= 0.0 {
        return Err(centre_det);
    }
    let mut points = [StressPoint { weight: 0.0, gradients: [[0.0; 3]; SHAPES] }; 8];
    for (at, corner) in points.iter_mut().zip(CORNERS) {
        let point = corner.map(|coordinate| coordinate / 3.0_f64.sqrt());
        let (inverse, det) = inverse(&jacobian(nodes_m, point));
        if det.is_nan() || det <= 0.0 {
            return Err(det);
        }
        let mut gradients = [[0.0; 3]; SHAPES];
        for (gradient, corner) in gradients.iter_mut().zip(CORNERS) {
            *gradient = product(&inverse, natural_gradient(corner, point));
        }
        for (mode, &coordinate) in point.iter().enumerate() {
            let mut natural = [0.0; 3];
            natural[mode] = -2.0 * coordinate;
            gradients[8 + mode] = product(&centre, natural).map(|slope| slope * centre_det / det);
        }
        *at = StressPoint { weight: det, gradients };
    }
    Ok(points)
}

/// A point of the 3x3x3 rule that integrates squares of incompatible modes.
pub(super) struct MassPoint {
    /// Weight, m³.
    pub weight: f64,
    pub shapes: [f64; SHAPES],
    /// Gradients of the shape functions, 1/m.
    pub gradients: [[f64; 3]; SHAPES],
}

/// The points at which mass is integrated, with gradients of the displacement field as it is.
pub(super) fn mass_points(nodes_m: &[[f64; 3]; 8]) -> impl Iterator<Item = MassPoint> + '_ {
    three_points().map(move |(point, [a, b, c])| {
        let (inverse, det) = inverse(&jacobian(nodes_m, point));
        let gradients = std::array::from_fn(|index| match index {
            0..8 => product(&inverse, natural_gradient(CORNERS[index], point)),
            mode => {
                let mut natural = [0.0; 3];
                natural[mode - 8] = -2.0 * point[mode - 8];
                product(&inverse, natural)
            }
        });
        MassPoint { weight: a * b * c * det, shapes: shapes_at(point), gradients }
    })
}

/// Natural coordinates and weights of the 3x3x3 Gauss points.
fn three_points() -> impl Iterator<Item = ([f64; 3], [f64; 3])> {
    let (points, weights) = ([-0.6_f64.sqrt(), 0.0, 0.6_f64.sqrt()], [5.0 / 9.0, 8.0 / 9.0, 5.0 / 9.0]);
    (0..27).map(move |index| {
        let [i, j, k] = [index % 3, index / 3 % 3, index / 9];
        ([points[i], points[j], points[k]], [weights[i], weights[j], weights[k]])
    })
}

/// Corner and incompatible shape functions at a point.
fn shapes_at(point: [f64; 3]) -> [f64; SHAPES] {
    std::array::from_fn(|shape_index| match shape_index {
        0..8 => shape(CORNERS[shape_index], point),
        mode => 1.0 - point[mode - 8].powi(2),
    })
}

/// The displacements of all shape functions that follow from those of the corners when the incompatible modes are
/// eliminated: `u_full = T u`, `33×24`.
///
/// # Errors
/// The determinant of the Jacobian, m³, if it is not above 0.
pub(super) fn following(nodes_m: &[[f64; 3]; 8], material: &Material) -> Result<[[f64; 24]; 3 * SHAPES], f64> {
    let (mut stiffness, mut none) = (full_stiffness(nodes_m, material)?, [[0.0; 3 * SHAPES]; 3 * SHAPES]);
    let follows = condense(&mut stiffness, &mut none);
    let mut of_corners = [[0.0; 24]; 3 * SHAPES];
    (0..24).for_each(|corner| of_corners[corner][corner] = 1.0);
    for (index, weights) in follows.iter().enumerate() {
        let row = 24 + index;
        of_corners[row] = std::array::from_fn(|column| (0..row).map(|j| weights[j] * of_corners[j][column]).sum());
    }
    Ok(of_corners)
}

/// Adds `w ∇ₐᵀ D ∇_b` of an isotropic material at one integration point with weight `w`: the block
/// `λ gₐ g_bᵀ + G (g_b gₐᵀ + gₐ·g_b I)` for every pair of shape functions. Blocks below the diagonal are computed,
/// those above are mirrored.
fn add_stiffness(
    full: &mut [[f64; 3 * SHAPES]; 3 * SHAPES],
    gradients: &[[f64; 3]; SHAPES],
    lambda: f64,
    shear: f64,
    weight: f64,
) {
    for (a, ga) in gradients.iter().enumerate() {
        for (b, gb) in gradients.iter().enumerate().take(a + 1) {
            let dot: f64 = ga.iter().zip(gb).map(|(x, y)| x * y).sum();
            for r in 0..3 {
                for s in 0..3 {
                    let identity = if r == s { dot } else { 0.0 };
                    let value = weight * (lambda * ga[r] * gb[s] + shear * (gb[r] * ga[s] + identity));
                    full[3 * a + r][3 * b + s] += value;
                    if a != b {
                        full[3 * b + s][3 * a + r] += value;
                    }
                }
            }
        }
    }
}

/// Adds `∫ ρ Nᵀ N dV` over corner and incompatible shape functions. 3x3x3 points are needed because squares of
/// incompatible modes are of fourth degree.
fn add_mass(full: &mut [[f64; 3 * SHAPES]; 3 * SHAPES], nodes_m: &[[f64; 3]; 8], density_kg_per_m3: f64) {
    for (point, [a, b, c]) in three_points() {
        // In this order of factors, on which the last bit of the mass depends.
        let weight = density_kg_per_m3 * a * b * c * inverse(&jacobian(nodes_m, point)).1;
        let shapes = shapes_at(point);
        for (a, of_a) in shapes.iter().enumerate() {
            for (b, of_b) in shapes.iter().enumerate() {
                for direction in 0..3 {
                    full[3 * a + direction][3 * b + direction] += weight * of_a * of_b;
                }
            }
        }
    }
}

/// Eliminates the incompatible modes, last first, by static condensation `α = T u` of the stiffness. The mass is
/// transformed with the same `T` (Guyan reduction). Both matrices stay exactly symmetric. Returns, for each of the
/// nine, the weights of the displacements before it that it follows.
fn condense(
    stiffness: &mut [[f64; 3 * SHAPES]; 3 * SHAPES],
    mass: &mut [[f64; 3 * SHAPES]; 3 * SHAPES],
) -> [[f64; 3 * SHAPES]; 9] {
    let mut all = [[0.0; 3 * SHAPES]; 9];
    for pivot in (24..3 * SHAPES).rev() {
        let (row, inertia) = (stiffness[pivot], mass[pivot]);
        let follows: [f64; 3 * SHAPES] = std::array::from_fn(|j| -row[j] / row[pivot]);
        for i in 0..pivot {
            for j in 0..=i {
                stiffness[i][j] += 0.5 * (row[i] * follows[j] + row[j] * follows[i]);
                mass[i][j] +=
                    inertia[i] * follows[j] + inertia[j] * follows[i] + inertia[pivot] * follows[i] * follows[j];
                (stiffness[j][i], mass[j][i]) = (stiffness[i][j], mass[i][j]);
            }
        }
        all[pivot - 24] = follows;
    }
    all
}

fn shape(corner: [f64; 3], point: [f64; 3]) -> f64 {
    (0..3).map(|axis| 0.5 * (1.0 + corner[axis] * point[axis])).product()
}

/// Gradient `∂N/∂(ξ, η, ζ)` of the shape function of a corner.
fn natural_gradient(corner: [f64; 3], point: [f64; 3]) -> [f64; 3] {
    let [x, y, z] = [0, 1, 2].map(|axis| 0.5 * (1.0 + corner[axis] * point[axis]));
    [0.5 * corner[0] * y * z, 0.5 * corner[1] * x * z, 0.5 * corner[2] * x * y]
}

/// Jacobian at a point in natural coordinates: row `i` is the derivative of the position `(x, y, z)` with respect to
/// natural coordinate `i`, m.
fn jacobian(nodes_m: &[[f64; 3]; 8], point: [f64; 3]) -> [[f64; 3]; 3] {
    let mut jacobian = [[0.0; 3]; 3];
    for (node_m, corner) in nodes_m.iter().zip(CORNERS) {
        for (row, slope) in jacobian.iter_mut().zip(natural_gradient(corner, point)) {
            for (entry, position) in row.iter_mut().zip(node_m) {
                *entry += slope * position;
            }
        }
    }
    jacobian
}

/// Inverse and determinant of a 3x3 matrix.
fn inverse(a: &[[f64; 3]; 3]) -> ([[f64; 3]; 3], f64) {
    let cofactor = |i: usize, j: usize| {
        let (r, s, u, v) = ((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3);
        a[r][u] * a[s][v] - a[r][v] * a[s][u]
    };
    let det = (0..3).map(|j| a[0][j] * cofactor(0, j)).sum::<f64>();
    (std::array::from_fn(|i| std::array::from_fn(|j| cofactor(j, i) / det)), det)
}

fn product(a: &[[f64; 3]; 3], x: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|j| a[i][j] * x[j]).sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEEL: Material = Material { density_kg_per_m3: 7800.0, young_pa: 210e9, poisson: 0.3 };

    /// A distorted brick without parallel edges.
    fn distorted() -> [[f64; 3]; 8] {
        let push = [0.13, -0.07, 0.11, 0.05, -0.12, 0.09, -0.04, 0.08];
        std::array::from_fn(|a| std::array::from_fn(|d| CORNERS[a][d] + push[(a + 3 * d) % 8]))
    }

    #[test]
    fn the_mass_is_density_times_volume_and_rigid_motions_have_no_stiffness() {
        let nodes = distorted();
        let matrices = brick(&nodes, &STEEL).unwrap();
        // A distorted 2x2x2 box. 2x2x2 Gauss points integrate its volume exactly, so a 5x5x5 rule must agree.
        let (points, weights) = (
            [-0.906_179_845_938_664, -0.538_469_310_105_683, 0.0, 0.538_469_310_105_683, 0.906_179_845_938_664],
            [
                0.236_926_885_056_189,
                0.478_628_670_499_366,
                0.568_888_888_888_889,
                0.478_628_670_499_366,
                0.236_926_885_056_189,
            ],
        );
        let mut volume = 0.0;
        for (x, wx) in points.iter().zip(weights) {
            for (y, wy) in points.iter().zip(weights) {
                for (z, wz) in points.iter().zip(weights) {
                    volume += wx * wy * wz * inverse(&jacobian(&nodes, [*x, *y, *z])).1;
                }
            }
        }
        // In a translation along x, the incompatible modes are zero.
        let total: f64 = (0..24)
            .step_by(3)
            .flat_map(|i| (0..24).step_by(3).map(move |j| (i, j)))
            .map(|(i, j)| matrices.mass[i][j])
            .sum();
        assert!((total / (7800.0 * volume) - 1.0).abs() < 1e-12, "{total}");
        let motions: [fn([f64; 3]) -> [f64; 3]; 6] = [
            |_| [1.0, 0.0, 0.0],
            |_| [0.0, 1.0, 0.0],
            |_| [0.0, 0.0, 1.0],
            |[_, y, z]| [0.0, -z, y],
            |[x, _, z]| [z, 0.0, -x],
            |[x, y, _]| [-y, x, 0.0],
        ];
        let largest = matrices.stiffness.iter().flatten().fold(0.0, |m: f64, k| m.max(k.abs()));
        for motion in motions {
            let u: Vec<f64> = nodes.iter().flat_map(|&node| motion(node)).collect();
            for row in &matrices.stiffness {
                let force: f64 = row.iter().zip(&u).map(|(k, u)| k * u).sum();
                // Rounding error of 24 products with entries up to `largest`.
                assert!(force.abs() < 100.0 * f64::EPSILON * largest, "{force}");
            }
        }
    }

    #[test]
    fn one_brick_in_bending_is_exact() {
        // Pure bending of a box about z with ν = 0: the energy is E I κ² L / 2 at the curvature κ = 1. The incompatible
        // modes represent the parabolic deflection; a trilinear brick would be 1.5 times as stiff.
        let material = Material { poisson: 0.0, ..STEEL };
        let nodes = CORNERS;
        let u: Vec<f64> = nodes.iter().flat_map(|&[x, y, _]| [-x * y, 0.0, 0.0]).collect();
        let stiffness = brick(&nodes, &material).unwrap().stiffness;
        let energy: f64 =
            (0..24).flat_map(|i| (0..24).map(move |j| (i, j))).map(|(i, j)| u[i] * stiffness[i][j] * u[j]).sum::<f64>()
                / 2.0;
        let second_moment = 2.0 * 2.0_f64.powi(3) / 12.0;
        let expected = material.young_pa * second_moment * 2.0 / 2.0;
        assert!((energy / expected - 1.0).abs() < 1e-13, "{energy} {expected}");
    }

    #[test]
    fn an_inverted_brick_is_refused_with_its_jacobian() {
        let mut nodes = CORNERS;
        nodes.swap(0, 4);
        nodes.swap(1, 5);
        nodes.swap(2, 6);
        nodes.swap(3, 7);
        assert_eq!(brick(&nodes, &STEEL), Err(-1.0));
    }
}
