//! A mesh with supports and springs, and its matrices.

use std::collections::BTreeSet;

use faer::sparse::SymbolicSparseColMat;

use super::{FemError, Mesh, brick};
use crate::reduction::SparseMatrix;

/// A spring along one direction, 0 to 2 for x, y, z: between two nodes, or from a node to the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spring {
    pub node: usize,
    pub other: Option<usize>,
    pub direction: usize,
    pub stiffness_n_per_m: f64,
}

/// A mesh, what holds it and what joins it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Structure {
    pub mesh: Mesh,
    /// Node and direction, 0 to 2, of each displacement held at 0. Hanging nodes move with others and are not held.
    pub fixed: BTreeSet<(usize, usize)>,
    pub springs: Vec<Spring>,
}

/// Matrices over the free degrees of freedom.
#[derive(Clone, Debug)]
pub struct Assembled {
    /// `K`, N/m, exactly symmetric, both triangles.
    pub stiffness: SparseMatrix,
    /// `M`, kg, exactly symmetric, both triangles.
    pub mass: SparseMatrix,
    /// Node and direction of each row, ascending.
    pub rows: Vec<(usize, usize)>,
}

impl Structure {
    /// Adds what another structure holds, joined to nothing; returns the number that its first node gets.
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

    /// How many degrees of freedom are free.
    pub fn dof(&self) -> usize {
        3 * (self.mesh.nodes_m.len() - self.mesh.hanging.len()) - self.fixed.len()
    }

    /// Stiffness and mass of bricks and springs over the free degrees of freedom.
    ///
    /// # Errors
    /// [`FemError`]: `Material`, `Inverted`, `Loose`, `Spring`.
    pub fn assemble(&self) -> Result<Assembled, FemError> {
        for component in &self.mesh.components {
            component.material.check(&component.name)?;
        }
        let rows = self.rows();
        let mut row_of = vec![[None; 3]; self.mesh.nodes_m.len()];
        for (row, &(node, direction)) in rows.iter().enumerate() {
            row_of[node][direction] = Some(row);
        }
        let neighbours = self.neighbours()?;
        let mut stiffness = Symmetric::new(&rows, |(node, _)| {
            neighbours[node].iter().flat_map(|&other| row_of[other]).flatten().collect()
        });
        let mut mass = Symmetric::new(&rows, |(node, direction)| {
            neighbours[node].iter().filter_map(|&other| row_of[other][direction]).collect()
        });
        for (index, element) in self.mesh.bricks.iter().enumerate() {
            let component = &self.mesh.components[element.component];
            let matrices = brick(&self.mesh.corners_m(element), &component.material)
                .map_err(|value| FemError::Inverted { brick: index, component: component.name.clone(), value })?;
            // Corner, independent node that it moves with, weight.
            let terms: Vec<(usize, usize, f64)> = element
                .nodes
                .iter()
                .enumerate()
                .flat_map(|(corner, &node)| self.mesh.weights(node).into_iter().map(move |(i, w)| (corner, i, w)))
                .collect();
            for &(a, node, weight) in &terms {
                for &(b, other, share) in &terms {
                    for d in 0..3 {
                        let Some(row) = row_of[node][d] else { continue };
                        for (e, column) in row_of[other].into_iter().enumerate() {
                            let Some(column) = column.filter(|&column| column <= row) else { continue };
                            stiffness.add(row, column, weight * share * matrices.stiffness[3 * a + d][3 * b + e]);
                            if d == e {
                                mass.add(row, column, weight * share * matrices.mass[a][b]);
                            }
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
        Ok(Assembled { stiffness: stiffness.finish(), mass: mass.finish(), rows })
    }

    /// The elongation of a spring as a sum over independent nodes.
    fn spring_terms(&self, spring: &Spring) -> Vec<(usize, f64)> {
        let other = spring.other.map_or(vec![], |other| self.mesh.weights(other));
        let negative = other.into_iter().map(|(node, weight)| (node, -weight));
        self.mesh.weights(spring.node).into_iter().chain(negative).collect()
    }

    /// For each independent node the nodes that share a brick or a spring with it, itself included, ascending.
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

/// A symmetric matrix of known pattern, filled in its lower triangle.
struct Symmetric {
    starts: Vec<usize>,
    rows: Vec<usize>,
    values: Vec<f64>,
}

impl Symmetric {
    /// Zeros where `of` says that a row's column has entries, ascending; the pattern is symmetric.
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

    /// Copies the lower triangle to the upper one, so that both are the same to the last bit.
    fn finish(mut self) -> SparseMatrix {
        let n = self.starts.len() - 1;
        // Columns are visited in order, so the entries above the diagonal of each column come in order as well.
        let mut upper = self.starts.clone();
        for column in 0..n {
            for entry in self.starts[column]..self.starts[column + 1] {
                let row = self.rows[entry];
                if row > column {
                    self.values[upper[row]] = self.values[entry];
                    upper[row] += 1;
                }
            }
        }
        let pattern = SymbolicSparseColMat::new_checked(n, n, self.starts, None, self.rows);
        SparseMatrix::new(pattern, self.values)
    }
}
