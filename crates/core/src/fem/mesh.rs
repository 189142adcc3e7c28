//! Structured meshes of bricks: boxes and annuli joined by shared nodes where their grid lines coincide and by hanging
//! nodes elsewhere.
//!
//! A [`Block`] is a lattice of grid lines in three coordinates, mapped to space. Where a node of a new block lies on an
//! older block, it is either the same node or a hanging node. A hanging node moves with the interpolation between nodes
//! of the older block, `u = Σ w_k u_k`. The displacement is continuous, and the patch test holds, as long as no grid
//! line of the older block crosses a cell of the new one within the common face.

use std::collections::BTreeMap;

use super::Material;

/// A named component of one material.
#[derive(Clone, Debug, PartialEq)]
pub struct Component {
    /// Name, as decks list it.
    pub name: String,
    /// Material of all its bricks.
    pub material: Material,
}

/// An 8-node brick, nodes ordered as `C3D8I` of Abaqus and CalculiX.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Brick {
    /// Indices of the corners in [`Mesh::nodes_m`].
    pub nodes: [usize; 8],
    /// Index in [`Mesh::components`].
    pub component: usize,
}

/// Nodes, bricks, components and hanging nodes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Positions of the nodes, m.
    pub nodes_m: Vec<[f64; 3]>,
    /// The bricks, each of one component.
    pub bricks: Vec<Brick>,
    /// The components, which bricks refer to by index.
    pub components: Vec<Component>,
    /// For each hanging node: the independent nodes it depends on and their weights, which sum to 1.
    pub hanging: BTreeMap<usize, Vec<(usize, f64)>>,
}

/// Shape of a lattice: which cells are filled, and whether the third coordinate is periodic.
#[derive(Clone, Copy)]
pub struct Extent<'a> {
    /// Whether the cell with these lattice indices has a brick.
    pub filled: &'a dyn Fn([usize; 3]) -> bool,
    /// Whether the last grid line of the third coordinate is the first one: a ring.
    pub closed: bool,
}

/// All cells filled, not periodic.
pub const SOLID: Extent<'static> = Extent { filled: &|_| true, closed: false };

/// A structured piece of a mesh.
#[derive(Clone, Debug)]
pub struct Block {
    /// Grid lines in each lattice coordinate, ascending.
    lines: [Vec<f64>; 3],
    /// Node at each lattice point; `None` where no filled cell touches it.
    nodes: Vec<Option<usize>>,
    /// Whether each cell is filled.
    filled: Vec<bool>,
}

/// Distance, relative to the length of the lattice, below which two lattice coordinates are equal.
const SAME: f64 = 1e-9;

impl Mesh {
    /// Adds a component and returns its index.
    pub fn add_component(&mut self, name: &str, material: Material) -> usize {
        self.components.push(Component { name: name.to_owned(), material });
        self.components.len() - 1
    }

    /// Adds a lattice of bricks of `component` between the grid lines `lines`. `place` maps lattice coordinates to
    /// metres and must preserve orientation. Where the block touches `neighbours`, it is joined to their nodes.
    pub fn add_block(
        &mut self,
        component: usize,
        lines: [Vec<f64>; 3],
        extent: Extent<'_>,
        neighbours: &[&Block],
        place: impl Fn([f64; 3]) -> [f64; 3],
    ) -> Block {
        let cells = [0, 1, 2].map(|axis| lines[axis].len() - 1);
        let filled = lattice(cells).map(|cell| (extent.filled)(cell)).collect();
        let mut block = Block { nodes: vec![None; cells.map(|count| count + 1).iter().product()], lines, filled };
        for cell in lattice(cells) {
            if !block.filled[offset(cell, cells)] {
                continue;
            }
            let nodes = CORNERS.map(|corner| {
                let mut point = [0, 1, 2].map(|axis| cell[axis] + corner[axis]);
                if extent.closed && point[2] == cells[2] {
                    point[2] = 0;
                }
                self.node_at(&mut block, point, neighbours, &place)
            });
            self.bricks.push(Brick { nodes, component });
        }
        if extent.closed {
            let [u, v, _] = cells;
            for (i, j) in (0..=u).flat_map(|i| (0..=v).map(move |j| (i, j))) {
                let last = block.offset([i, j, cells[2]]);
                block.nodes[last] = block.nodes[block.offset([i, j, 0])];
            }
        }
        block
    }

    /// The node at a lattice point of a block, created if it does not exist yet.
    fn node_at(
        &mut self,
        block: &mut Block,
        point: [usize; 3],
        neighbours: &[&Block],
        place: impl Fn([f64; 3]) -> [f64; 3],
    ) -> usize {
        let offset = block.offset(point);
        if let Some(node) = block.nodes[offset] {
            return node;
        }
        let at = [0, 1, 2].map(|axis| block.lines[axis][point[axis]]);
        let node = match neighbours.iter().find_map(|neighbour| neighbour.locate(at)).as_deref() {
            None => self.add_node(place(at)),
            Some(&[(node, _)]) => node,
            Some(between) => self.add_hanging(between),
        };
        block.nodes[offset] = Some(node);
        node
    }

    fn add_node(&mut self, position_m: [f64; 3]) -> usize {
        self.nodes_m.push(position_m);
        self.nodes_m.len() - 1
    }

    /// Adds a hanging node that depends on `between`, at the interpolated position.
    fn add_hanging(&mut self, between: &[(usize, f64)]) -> usize {
        let mut weights = BTreeMap::new();
        for &(node, weight) in between {
            for (independent, share) in self.weights(node) {
                *weights.entry(independent).or_insert(0.0) += weight * share;
            }
        }
        let weights: Vec<(usize, f64)> = weights.into_iter().collect();
        let position_m =
            [0, 1, 2].map(|axis| weights.iter().map(|&(node, weight)| weight * self.nodes_m[node][axis]).sum());
        let node = self.add_node(position_m);
        self.hanging.insert(node, weights);
        node
    }

    /// Adds a copy of another mesh without joining it; returns the index of its first node.
    pub fn append(&mut self, other: &Mesh) -> usize {
        let (node, component) = (self.nodes_m.len(), self.components.len());
        self.nodes_m.extend_from_slice(&other.nodes_m);
        self.components.extend_from_slice(&other.components);
        self.bricks.extend(other.bricks.iter().map(|brick| Brick {
            nodes: brick.nodes.map(|corner| node + corner),
            component: component + brick.component,
        }));
        self.hanging.extend(other.hanging.iter().map(|(&hangs, weights)| {
            (node + hangs, weights.iter().map(|&(independent, weight)| (node + independent, weight)).collect())
        }));
        node
    }

    /// The independent nodes that a node depends on, with weights: the node itself, unless it is a hanging node.
    pub fn weights(&self, node: usize) -> Vec<(usize, f64)> {
        self.hanging.get(&node).cloned().unwrap_or_else(|| vec![(node, 1.0)])
    }

    /// Positions of the corners of a brick, m.
    pub fn corners_m(&self, brick: &Brick) -> [[f64; 3]; 8] {
        brick.nodes.map(|node| self.nodes_m[node])
    }
}

/// Corners of a lattice cell in the order of [`Brick::nodes`].
const CORNERS: [[usize; 3]; 8] =
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]];

/// All index triples below the given counts; the first index varies fastest.
fn lattice([u, v, w]: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..w).flat_map(move |k| (0..v).flat_map(move |j| (0..u).map(move |i| [i, j, k])))
}

fn offset([i, j, k]: [usize; 3], counts: [usize; 3]) -> usize {
    (k * counts[1] + j) * counts[0] + i
}

impl Block {
    /// Number of grid lines in each lattice coordinate.
    pub fn counts(&self) -> [usize; 3] {
        [0, 1, 2].map(|axis| self.lines[axis].len())
    }

    /// The node at a lattice point.
    ///
    /// # Panics
    /// If the lattice has no node there.
    pub fn node(&self, point: [usize; 3]) -> usize {
        self.nodes[self.offset(point)].expect("a node of a filled cell")
    }

    /// Grid lines in one lattice coordinate.
    pub fn lines(&self, axis: usize) -> &[f64] {
        &self.lines[axis]
    }

    fn offset(&self, point: [usize; 3]) -> usize {
        offset(point, self.counts())
    }

    /// Nodes and weights that interpolate at the lattice coordinates `at`; `None` outside the filled cells.
    pub fn locate(&self, at: [f64; 3]) -> Option<Vec<(usize, f64)>> {
        // Per coordinate: the preceding grid line, the weight of the next one, and the first and last cell that touch
        // the position.
        let mut found = [(0, 0.0, [0, 0]); 3];
        for axis in 0..3 {
            let lines = &self.lines[axis];
            let last = lines.len() - 1;
            let near = SAME * (lines[last] - lines[0]);
            let next = lines.partition_point(|&line| line < at[axis] - near);
            found[axis] = match lines.get(next) {
                Some(&line) if line <= at[axis] + near => (next, 0.0, [next.saturating_sub(1), (next + 1).min(last)]),
                Some(&line) if next > 0 => {
                    (next - 1, (at[axis] - lines[next - 1]) / (line - lines[next - 1]), [next - 1, next])
                }
                _ => return None,
            };
        }
        let cells = self.counts().map(|count| count - 1);
        let spans = found.map(|(_, _, [from, to])| to - from);
        let touched = |step: [usize; 3]| [0, 1, 2].map(|axis| found[axis].2[0] + step[axis]);
        if !lattice(spans).any(|step| self.filled[offset(touched(step), cells)]) {
            return None;
        }
        let weights = CORNERS.iter().filter_map(|corner| {
            let weight: f64 =
                (0..3).map(|axis| if corner[axis] == 1 { found[axis].1 } else { 1.0 - found[axis].1 }).product();
            let point = [0, 1, 2].map(|axis| found[axis].0 + corner[axis]);
            (weight > 0.0).then(|| (self.node(point), weight))
        });
        Some(weights.collect())
    }
}

/// Grid lines through `breakpoints`, ascending; every interval is divided evenly into pieces of about `spacing`.
pub fn stations(breakpoints: &[f64], spacing: f64) -> Vec<f64> {
    let mut lines = vec![breakpoints[0]];
    for pair in breakpoints.windows(2) {
        lines.extend(divided(pair[0], pair[1], pieces(pair[1] - pair[0], spacing)));
    }
    lines
}

/// Number of pieces of about `spacing` in a length, at least 1.
pub fn pieces(length: f64, spacing: f64) -> usize {
    (length / spacing).round().max(1.0) as usize
}

/// The upper ends of `count` equal pieces between two values; the last is exactly `to`.
pub fn divided(from: f64, to: f64, count: usize) -> impl Iterator<Item = f64> {
    let step = (to - from) / count as f64;
    (1..=count).map(move |piece| if piece == count { to } else { from + step * piece as f64 })
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEEL: Material = Material { density_kg_per_m3: 7800.0, young_pa: 210e9, poisson: 0.3 };

    #[test]
    fn blocks_share_nodes_where_lines_meet_and_hang_them_elsewhere() {
        let mut mesh = Mesh::default();
        let steel = mesh.add_component("steel", STEEL);
        let coarse = stations(&[0.0, 2.0], 1.0);
        let below = mesh.add_block(steel, [coarse.clone(), vec![-1.0, 0.0], coarse], SOLID, &[], |at| at);
        let fine = stations(&[0.0, 1.0], 0.5);
        let above = mesh.add_block(steel, [fine.clone(), vec![0.0, 1.0], fine], SOLID, &[&below], |at| at);
        assert_eq!(mesh.bricks.len(), 4 + 4);
        // 18 nodes below; above, 9 on the top face and at the bottom 4 shared corners and 5 hanging nodes.
        assert_eq!(mesh.nodes_m.len(), 18 + 9 + 5);
        assert_eq!(mesh.hanging.len(), 5);
        assert_eq!(above.node([0, 0, 0]), below.node([0, 1, 0]));
        let middle = above.node([1, 0, 1]);
        assert_eq!(mesh.nodes_m[middle], [0.5, 0.0, 0.5]);
        assert_eq!(mesh.weights(middle).len(), 4);
        assert!(mesh.weights(middle).iter().all(|&(_, weight)| weight == 0.25));
    }

    #[test]
    fn an_annulus_closes_and_a_hole_in_it_is_no_place() {
        let mut mesh = Mesh::default();
        let steel = mesh.add_component("steel", STEEL);
        let turn = std::f64::consts::TAU;
        let lines = [vec![1.0, 2.0, 3.0, 4.0], vec![0.0, 0.5], stations(&[0.0, turn], turn / 8.0)];
        let extent = Extent { filled: &|[i, _, k]| !(i == 1 && k == 2), closed: true };
        let ring = mesh.add_block(steel, lines, extent, &[], |[r, y, t]| [r * t.cos(), y, r * t.sin()]);
        assert_eq!(mesh.nodes_m.len(), 4 * 2 * 8);
        assert_eq!(mesh.bricks.len(), 3 * 8 - 1);
        assert_eq!(ring.node([2, 1, 0]), ring.node([2, 1, 8]));
        assert_eq!(ring.locate([2.5, 0.0, 2.5 * turn / 8.0]), None);
        assert_eq!(ring.locate([3.0, 0.0, 2.5 * turn / 8.0]).map(|weights| weights.len()), Some(2));
        assert_eq!(ring.locate([4.5, 0.0, 1.0]), None);
    }
}
