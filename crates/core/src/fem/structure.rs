//! A mesh with supports and springs, and its assembled matrices.

use std::collections::BTreeSet;

use faer::sparse::SymbolicSparseColMat;

use super::{Brick, FemError, Material, Mesh, brick};
use crate::reduction::SparseMatrix;

/// A spring along one direction (0 to 2 for x, y, z) between two nodes, or between a node and the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spring {
    /// Index of the node.
    pub node: usize,
    /// Index of the other node; `None` for the ground.
    pub other: Option<usize>,
    /// 0, 1 or 2 for x, y or z.
    pub direction: usize,
    /// Stiffness, N/m, above 0.
    pub stiffness_n_per_m: f64,
}

/// A mesh with its supports and springs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Structure {
    /// Nodes and bricks.
    pub mesh: Mesh,
    /// Node and direction, 0 to 2, of each displacement fixed at 0. Hanging nodes depend on others and cannot be fixed.
    pub fixed: BTreeSet<(usize, usize)>,
    /// Springs between nodes, or to the ground.
    pub springs: Vec<Spring>,
}

/// Matrices over the free degrees of freedom.
#[derive(Clone, Debug)]
pub struct Assembled {
    /// `K`, N/m, `n×n`, exactly symmetric, both triangles stored.
    pub stiffness: SparseMatrix,
    /// `M`, kg, `n×n`, exactly symmetric, both triangles stored.
    pub mass: SparseMatrix,
    /// Node and direction of each row, ascending.
    pub rows: Vec<(usize, usize)>,
}

impl Structure {
    /// Adds a copy of another structure without joining it; returns the index of its first node.
    pub fn append(&mut self, other: &Structure) -> usize {
        let node = self.mesh.append(&other.mesh);
        self.fixed.extend(other.fixed.iter().map(|&(held, direction)| (node + held, direction)));
        self.springs.extend(other.springs.iter().map(|spring| Spring {
            node: node + spring.node,
            other: spring.other.map(|other| node + other),
            ..*spring
        }));
        node
    }

    /// Node and direction of each free degree of freedom, ascending.
    pub fn rows(&self) -> Vec<(usize, usize)> {
        (0..self.mesh.nodes_m.len())
            .filter(|node| !self.mesh.hanging.contains_key(node))
            .flat_map(|node| (0..3).map(move |direction| (node, direction)))
            .filter(|row| !self.fixed.contains(row))
            .collect()
    }

    /// Number of free degrees of freedom.
    pub fn dof(&self) -> usize {
        3 * (self.mesh.nodes_m.len() - self.mesh.hanging.len()) - self.fixed.len()
    }

    /// Assembles stiffness and mass of bricks and springs over the free degrees of freedom.
    ///
    /// # Errors
    /// [`FemError`]: `Material`, `Inverted`, `Loose`, `Spring`.
    pub fn assemble(&self) -> Result<Assembled, FemError> {
        for component in &self.mesh.components {
            component.material.check(&component.name)?;
        }
        let rows = self.rows();
        let row_of = self.row_of(&rows);
        let neighbours = self.neighbours()?;
        let pattern = |(node, _): (usize, usize)| -> Vec<usize> {
            neighbours[node].iter().flat_map(|&other| row_of[other]).flatten().collect()
        };
        let (mut stiffness, mut mass) = (Mirrored::new(&rows, pattern), Mirrored::new(&rows, pattern));
        for (index, element) in self.mesh.bricks.iter().enumerate() {
            let (nodes_m, material) = self.brick_at(index);
            let matrices = brick(&nodes_m, material).map_err(|value| self.inverted(index, value))?;
            let terms = self.corner_terms(element);
            for &(a, node, weight) in &terms {
                for &(b, other, share) in &terms {
                    for d in 0..3 {
                        let Some(row) = row_of[node][d] else { continue };
                        for (e, column) in row_of[other].into_iter().enumerate() {
                            let Some(column) = column.filter(|&column| column <= row) else { continue };
                            stiffness.add(row, column, weight * share * matrices.stiffness[3 * a + d][3 * b + e]);
                            mass.add(row, column, weight * share * matrices.mass[3 * a + d][3 * b + e]);
                        }
                    }
                }
            }
        }
        for (index, spring) in self.springs.iter().enumerate() {
            let value = spring.stiffness_n_per_m;
            if !(value.is_finite() && value > 0.0) {
                return Err(FemError::Spring { spring: index, value });
            }
            let terms = self.spring_terms(spring);
            for &(node, weight) in &terms {
                for &(other, share) in &terms {
                    let (row, column) = (row_of[node][spring.direction], row_of[other][spring.direction]);
                    if let (Some(row), Some(column)) = (row, column)
                        && column <= row
                    {
                        stiffness.add(row, column, weight * share * value);
                    }
                }
            }
        }
        let symmetric = Entry::Symmetric;
        Ok(Assembled { stiffness: stiffness.finish(symmetric), mass: mass.finish(symmetric), rows })
    }

    /// Assembles one matrix over the free degrees of freedom from that of every brick, by the index of the brick.
    ///
    /// # Errors
    /// [`FemError::Loose`].
    pub(super) fn assemble_bricks(
        &self,
        entry: Entry,
        of_brick: &mut dyn FnMut(usize) -> [[f64; 24]; 24],
    ) -> Result<SparseMatrix, FemError> {
        let rows = self.rows();
        let (row_of, neighbours) = (self.row_of(&rows), self.neighbours()?);
        let pattern = |(node, _): (usize, usize)| -> Vec<usize> {
            neighbours[node].iter().flat_map(|&other| row_of[other]).flatten().collect()
        };
        let mut sum = Mirrored::new(&rows, pattern);
        for (index, element) in self.mesh.bricks.iter().enumerate() {
            let matrix = of_brick(index);
            let terms = self.corner_terms(element);
            for &(a, node, weight) in &terms {
                for &(b, other, share) in &terms {
                    for d in 0..3 {
                        let Some(row) = row_of[node][d] else { continue };
                        for (e, column) in row_of[other].into_iter().enumerate() {
                            let Some(column) = column.filter(|&column| column <= row) else { continue };
                            sum.add(row, column, weight * share * matrix[3 * a + d][3 * b + e]);
                        }
                    }
                }
            }
        }
        Ok(sum.finish(entry))
    }

    /// The row of each direction of every node; `None` if it is fixed or hangs on others.
    pub(super) fn row_of(&self, rows: &[(usize, usize)]) -> Vec<[Option<usize>; 3]> {
        let mut row_of = vec![[None; 3]; self.mesh.nodes_m.len()];
        for (row, &(node, direction)) in rows.iter().enumerate() {
            row_of[node][direction] = Some(row);
        }
        row_of
    }

    /// Corners and material of a brick.
    pub(super) fn brick_at(&self, index: usize) -> ([[f64; 3]; 8], &Material) {
        let element = &self.mesh.bricks[index];
        (self.mesh.corners_m(element), &self.mesh.components[element.component].material)
    }

    pub(super) fn inverted(&self, index: usize, value: f64) -> FemError {
        let component = self.mesh.components[self.mesh.bricks[index].component].name.clone();
        FemError::Inverted { brick: index, component, value }
    }

    /// Corner, independent node that it depends on, and weight.
    fn corner_terms(&self, element: &Brick) -> Vec<(usize, usize, f64)> {
        let corners = element.nodes.iter().enumerate();
        corners
            .flat_map(|(corner, &node)| self.mesh.weights(node).into_iter().map(move |(i, w)| (corner, i, w)))
            .collect()
    }

    /// The elongation of a spring as a weighted sum over independent nodes.
    fn spring_terms(&self, spring: &Spring) -> Vec<(usize, f64)> {
        let other = spring.other.map_or(vec![], |other| self.mesh.weights(other));
        let negative = other.into_iter().map(|(node, weight)| (node, -weight));
        self.mesh.weights(spring.node).into_iter().chain(negative).collect()
    }

    /// For each independent node: the nodes that share a brick or a spring with it, itself included, ascending.
    ///
    /// # Errors
    /// [`FemError::Loose`].
    fn neighbours(&self) -> Result<Vec<Vec<usize>>, FemError> {
        let independent = |nodes: &[usize]| -> Vec<usize> {
            nodes.iter().flat_map(|&node| self.mesh.weights(node)).map(|(node, _)| node).collect()
        };
        let mut groups: Vec<Vec<usize>> = self.mesh.bricks.iter().map(|brick| independent(&brick.nodes)).collect();
        let mut groups_of = vec![vec![]; self.mesh.nodes_m.len()];
        for (index, brick) in self.mesh.bricks.iter().enumerate() {
            for node in brick.nodes {
                groups_of[node].push(index);
            }
        }
        if let Some(node) = groups_of.iter().position(Vec::is_empty) {
            return Err(FemError::Loose { node });
        }
        groups.extend(self.springs.iter().map(|s| self.spring_terms(s).into_iter().map(|(node, _)| node).collect()));
        groups_of.iter_mut().for_each(Vec::clear);
        for (index, group) in groups.iter().enumerate() {
            for &node in group {
                groups_of[node].push(index);
            }
        }
        Ok(groups_of
            .into_iter()
            .map(|indices| {
                let mut nodes: Vec<usize> = indices.into_iter().flat_map(|index| &groups[index]).copied().collect();
                nodes.sort_unstable();
                nodes.dedup();
                nodes
            })
            .collect())
    }
}

/// How the entries above the diagonal follow from those below it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Entry {
    /// They are equal.
    Symmetric,
    /// They have the opposite sign, and the diagonal is 0.
    Skew,
}

/// A symmetric or skew matrix of known, symmetric pattern, assembled in its lower triangle.
struct Mirrored {
    starts: Vec<usize>,
    rows: Vec<usize>,
    values: Vec<f64>,
}

impl Mirrored {
    /// A zero matrix; `of` returns the rows, ascending, with entries in the column of a degree of freedom. The pattern
    /// must be symmetric.
    fn new(rows: &[(usize, usize)], of: impl Fn((usize, usize)) -> Vec<usize>) -> Self {
        let (mut starts, mut entries) = (vec![0], vec![]);
        for &row in rows {
            entries.extend(of(row));
            starts.push(entries.len());
        }
        Self { starts, values: vec![0.0; entries.len()], rows: entries }
    }

    fn add(&mut self, row: usize, column: usize, value: f64) {
        let start = self.starts[column];
        let within = self.rows[start..self.starts[column + 1]].binary_search(&row).expect("an entry of the pattern");
        self.values[start + within] += value;
    }

    /// Copies the lower triangle to the upper one, so that both agree exactly.
    fn finish(mut self, entry: Entry) -> SparseMatrix {
        let n = self.starts.len() - 1;
        // Columns are visited in ascending order, so the entries above the diagonal of each column are filled in
        // ascending order too.
        let mut upper = self.starts.clone();
        for column in 0..n {
            for place in self.starts[column]..self.starts[column + 1] {
                let row = self.rows[place];
                if row > column {
                    self.values[upper[row]] = match entry {
                        Entry::Symmetric => self.values[place],
                        Entry::Skew => -self.values[place],
                    };
                    upper[row] += 1;
                } else if row == column && entry == Entry::Skew {
                    self.values[place] = 0.0;
                }
            }
        }
        let pattern = SymbolicSparseColMat::new_checked(n, n, self.starts, None, self.rows);
        SparseMatrix::new(pattern, self.values)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use faer::Mat;

    use super::*;
    use crate::fem::{Extent, SOLID, stations};
    use crate::reduction::lowest_modes;

    const STEEL: Material = Material { density_kg_per_m3: 7800.0, young_pa: 210e9, poisson: 0.27 };

    /// A coarse box below a finer one with hanging nodes; all inner nodes are displaced, so that bricks are distorted.
    fn two_boxes() -> Structure {
        let mut mesh = Mesh::default();
        let steel = mesh.add_component("steel", STEEL);
        let push = |[x, y, z]: [f64; 3]| {
            let bump = 0.05 * (PI * x).sin() * (PI * z).sin() * (PI * (y + 1.0) / 2.0).sin();
            [x + bump, y - 0.7 * bump, z + 0.4 * bump]
        };
        let coarse = stations(&[0.0, 1.0], 0.5);
        let lines = [coarse.clone(), stations(&[-1.0, 0.0], 0.5), coarse];
        let below = mesh.add_block(steel, lines, SOLID, &[], push);
        let fine = stations(&[0.0, 1.0], 0.25);
        mesh.add_block(steel, [fine.clone(), stations(&[0.0, 1.0], 0.5), fine], SOLID, &[&below], push);
        assert!(!mesh.hanging.is_empty());
        Structure { mesh, ..Structure::default() }
    }

    /// The displacement field `u` evaluated at every row.
    fn field(structure: &Structure, rows: &[(usize, usize)], u: impl Fn([f64; 3]) -> [f64; 3]) -> Mat<f64> {
        Mat::from_fn(rows.len(), 1, |row, _| u(structure.mesh.nodes_m[rows[row].0])[rows[row].1])
    }

    #[test]
    fn constant_strain_is_exact_across_hanging_nodes_and_distorted_bricks() {
        let structure = two_boxes();
        let Assembled { stiffness, rows, .. } = structure.assemble().unwrap();
        let gradient = [[1e-3, 2e-4, -3e-4], [5e-4, -8e-4, 1e-4], [2e-4, 6e-4, 4e-4]];
        let u = field(&structure, &rows, |at| gradient.map(|row| row.iter().zip(at).map(|(g, x)| g * x).sum()));
        let forces = &stiffness * &u;
        let largest = forces.norm_max();
        for (row, &(node, direction)) in rows.iter().enumerate() {
            let [x, y, z] = structure.mesh.nodes_m[node];
            let inside = |value: f64, low: f64| value > low + 1e-9 && value < 1.0 - 1e-9;
            if inside(x, 0.0) && inside(y, -1.0) && inside(z, 0.0) {
                // Equilibrium inside: the forces of neighbouring bricks cancel to rounding.
                assert!(forces[(row, 0)].abs() < 1e-12 * largest, "{node} {direction}: {}", forces[(row, 0)]);
            }
        }
        // Expected: ½ ε : D : ε times the volume, 1x2x1.
        let (lambda, shear) = STEEL.lame_pa();
        let strain = |i: usize, j: usize| 0.5 * (gradient[i][j] + gradient[j][i]);
        let trace: f64 = (0..3).map(|i| strain(i, i)).sum();
        let squares: f64 = (0..9).map(|k| strain(k / 3, k % 3).powi(2)).sum();
        let expected = (0.5 * lambda * trace * trace + shear * squares) * 2.0;
        let energy = 0.5 * (u.transpose() * &forces)[(0, 0)];
        assert!((energy / expected - 1.0).abs() < 1e-12, "{energy} {expected}");
    }

    #[test]
    fn a_free_body_has_its_mass_and_six_rigid_motions() {
        let structure = two_boxes();
        let Assembled { stiffness, mass, rows } = structure.assemble().unwrap();
        for direction in 0..3 {
            let shift = field(&structure, &rows, |_| std::array::from_fn(|d| if d == direction { 1.0 } else { 0.0 }));
            let total = (shift.transpose() * &mass * &shift)[(0, 0)];
            assert!((total / (7800.0 * 2.0) - 1.0).abs() < 1e-13, "{total}");
        }
        let squares = lowest_modes("boxes", &mass, &stiffness, 7).unwrap().omega_squared;
        assert!(squares[..6].iter().all(|square| square.abs() < 1e-9 * squares[6]), "{squares:?}");
    }

    #[test]
    fn springs_and_supports_hold() {
        let mut structure = two_boxes();
        let spring = |node, other, direction| Spring { node, other, direction, stiffness_n_per_m: 3e6 };
        // A spring from a hanging node to the ground, and one between two corners.
        let hangs = *structure.mesh.hanging.keys().next().unwrap();
        structure.springs = vec![spring(hangs, None, 1), spring(0, Some(2), 0)];
        let before = two_boxes().assemble().unwrap();
        let Assembled { stiffness, rows, .. } = structure.assemble().unwrap();
        let u = field(&structure, &rows, |[x, y, z]| [x * x, y + z, 0.0]);
        let energy = |k: &SparseMatrix| 0.5 * (u.transpose() * k * &u)[(0, 0)];
        let nodes = &structure.mesh.nodes_m;
        let [_, y, z] = nodes[hangs];
        let elongation = nodes[0][0].powi(2) - nodes[2][0].powi(2);
        let expected = 0.5 * 3e6 * ((y + z).powi(2) + elongation.powi(2));
        let added = energy(&stiffness) - energy(&before.stiffness);
        // A difference of energies near 1e11 J with 16 digits each.
        assert!((added - expected).abs() < 1e-3 && expected > 1e4, "{added} {expected}");

        structure.fixed.insert((1, 2));
        let held = structure.assemble().unwrap();
        assert_eq!(held.rows.len(), structure.dof());
        assert!(!held.rows.contains(&(1, 2)));
        structure.springs[0].stiffness_n_per_m = -1.0;
        assert_eq!(structure.assemble().unwrap_err(), FemError::Spring { spring: 0, value: -1.0 });
        structure.springs.clear();
        structure.mesh.nodes_m.push([9.0; 3]);
        let node = structure.mesh.nodes_m.len() - 1;
        assert_eq!(structure.assemble().unwrap_err(), FemError::Loose { node });
    }

    /// Natural frequencies, Hz, of a strip in plane strain, `length` by `2 half`, with x fixed at both ends. The mesh
    /// has `pieces` bricks along the strip and `pieces / 8` across.
    fn strip_hz(material: Material, length: f64, half: f64, pieces: usize, count: usize) -> Vec<f64> {
        let mut mesh = Mesh::default();
        let component = mesh.add_component("strip", material);
        let lines = [
            stations(&[0.0, length], length / pieces as f64),
            stations(&[-half, half], 16.0 * half / pieces as f64),
            vec![0.0, half],
        ];
        let extent = Extent { filled: &|_| true, closed: false };
        mesh.add_block(component, lines, extent, &[], |at| at);
        let mut structure = Structure { mesh, ..Structure::default() };
        for (node, [x, _, _]) in structure.mesh.nodes_m.iter().enumerate() {
            structure.fixed.insert((node, 2));
            if *x < 1e-12 || *x > length - 1e-12 {
                structure.fixed.insert((node, 0));
            }
        }
        let Assembled { stiffness, mass, .. } = structure.assemble().unwrap();
        let modes = lowest_modes("strip", &mass, &stiffness, count).unwrap();
        modes.omega_squared.iter().map(|square| square.max(0.0).sqrt() / TAU).collect()
    }

    #[test]
    fn frequencies_converge_with_the_square_of_the_spacing() {
        // Bending of a strip between planes of symmetry: the lowest antisymmetric Rayleigh-Lamb wave with half a
        // wavelength in the length, 4 k² P Q tanh(Q h) = (Q² + k²)² tanh(P h), P² = k² - ω²/c_L², Q² = k² - ω²/c_T².
        let (length, half) = (0.4, 0.025);
        let (lambda, shear) = STEEL.lame_pa();
        let k = PI / length;
        let [longitudinal, transverse] =
            [lambda + 2.0 * shear, shear].map(|modulus| (modulus / STEEL.density_kg_per_m3).sqrt());
        let dispersion = |omega: f64| {
            let [p, q] = [longitudinal, transverse].map(|speed| (k * k - (omega / speed).powi(2)).sqrt());
            4.0 * k * k * p * q * (q * half).tanh() - (q * q + k * k).powi(2) * (p * half).tanh()
        };
        let (mut low, mut high) = (0.01 * k * transverse, 0.99 * k * transverse);
        assert!(dispersion(low) * dispersion(high) < 0.0);
        for _ in 0..200 {
            let middle = 0.5 * (low + high);
            if dispersion(low) * dispersion(middle) <= 0.0 { high = middle } else { low = middle }
        }
        let exact = low / TAU;
        // The strip also has a rigid-body mode along y, so bending is the second frequency.
        let errors = [32, 64, 128].map(|pieces| strip_hz(STEEL, length, half, pieces, 2)[1] / exact - 1.0);
        eprintln!("bending: {exact} Hz, errors {errors:?}");
        for pair in errors.windows(2) {
            let order = (pair[0] / pair[1]).log2();
            assert!((order - 2.0).abs() < 0.1, "order {order}");
        }
        assert!(errors[2].abs() < 1e-4, "{errors:?}");
    }
}
