//! Interpolation of displacements between the nodes of the disc's contact surface: the rows of `T`.
//!
//! Nodes and contact point are projected along the patch's normal. The point gets the linear (barycentric) weights of
//! the Delaunay triangle that contains it. These weights are a partition of unity, exact for displacements linear in
//! position (rigid motions, uniform strain) and continuous over the surface. The triangle of each point is the optimal
//! basis of a linear programme,
//!
//! ```text
//! minimise Σ w_j |x_j - x|²   subject to   Σ w_j x_j = x,   Σ w_j = 1,   w ≥ 0
//! ```
//!
//! because it is the facet below the point on the lifted paraboloid. No triangulation has to be built or stored. A
//! point outside the surface, by no more than the search distance, is extrapolated linearly from the nearest triangle.
//!
//! Source: Edelsbrunner, Seidel, "Voronoi diagrams and arrangements", Discrete Comput. Geom. 1 (1986) 25-44, for the
//! lifting; Bland, Math. Oper. Res. 2 (1977) 103-107, for the pivot rule that cannot cycle.

use super::patch::{cross, dot};

/// Largest distance from a point to the nodes of its triangle, in units of the node spacing or of the search distance,
/// whichever is larger. A point farther from its nodes lies over a hole in the surface.
const FARTHEST: f64 = 50.0;
/// Largest absolute weight of an extrapolation. Larger weights come from a triangle too thin to extrapolate from.
const LARGEST_WEIGHT: f64 = 4.0;

/// A unit normal and two orthogonal unit vectors that span the plane perpendicular to it.
#[derive(Clone, Copy, Debug)]
pub struct Plane {
    normal: [f64; 3],
    first: [f64; 3],
    second: [f64; 3],
}

impl Plane {
    /// The plane perpendicular to a unit normal.
    pub fn across(normal: [f64; 3]) -> Self {
        // The coordinate axis least parallel to the normal.
        let mut axis = [0.0; 3];
        let smallest = (0..3).min_by(|&a, &b| normal[a].abs().total_cmp(&normal[b].abs())).unwrap_or(0);
        axis[smallest] = 1.0;
        let first = cross(normal, axis);
        let first = first.map(|value| value / dot(first, first).sqrt());
        Self { normal, first, second: cross(normal, first) }
    }

    fn seen(&self, point: [f64; 3]) -> [f64; 2] {
        [dot(point, self.first), dot(point, self.second)]
    }
}

/// The nodes of a surface, projected along its normal.
#[derive(Clone, Debug)]
pub struct Interpolation {
    plane: Plane,
    seen: Vec<[f64; 2]>,
    height: Vec<f64>,
    spacing: f64,
    search: f64,
}

impl Interpolation {
    /// `nodes` are positions in m. `search_m` is the largest distance of a point from the surface, in the plane and
    /// along the normal; the default is the median distance between neighbouring nodes.
    pub fn new(nodes: &[[f64; 3]], plane: Plane, search_m: Option<f64>) -> Self {
        let seen: Vec<[f64; 2]> = nodes.iter().map(|&node| plane.seen(node)).collect();
        let height = nodes.iter().map(|&node| dot(node, plane.normal)).collect();
        let mut nearest: Vec<f64> = (0..seen.len())
            .map(|a| {
                let others = (0..seen.len()).filter(|&b| b != a);
                others.map(|b| distance(seen[a], seen[b])).filter(|d| *d > 0.0).fold(f64::INFINITY, f64::min)
            })
            .filter(|distance| distance.is_finite())
            .collect();
        nearest.sort_by(f64::total_cmp);
        let spacing = nearest.get(nearest.len() / 2).copied().unwrap_or(0.0);
        Self { plane, seen, height, spacing, search: search_m.unwrap_or(spacing) }
    }

    /// The nodes that carry a point, each with its weight; weights sum to 1.
    ///
    /// # Errors
    /// What was found and what was expected, if the point is too far from the surface.
    pub fn weights(&self, point: [f64; 3]) -> Result<Vec<(usize, f64)>, (String, String)> {
        let (at, above) = (self.plane.seen(point), dot(point, self.plane.normal));
        // Only nodes near the height of the point: a disc has two faces.
        let mut near: Vec<(usize, [f64; 2])> = (0..self.seen.len())
            .filter(|&node| (self.height[node] - above).abs() <= self.search)
            .map(|node| (node, [self.seen[node][0] - at[0], self.seen[node][1] - at[1]]))
            .collect();
        if near.is_empty() {
            let closest = self.height.iter().map(|height| (height - above).abs()).fold(f64::INFINITY, f64::min);
            return Err((
                format!("the nearest node along the normal is {closest:.6e} m away"),
                format!("at most {:.6e} m (search_distance_m)", self.search),
            ));
        }
        near.sort_by(|a, b| length(a.1).total_cmp(&length(b.1)).then(a.0.cmp(&b.0)));
        let points: Vec<[f64; 2]> = near.iter().map(|(_, relative)| *relative).collect();
        let local = match inside(&points) {
            Some(weights) => weights,
            None => self.extrapolated(&points)?,
        };
        let farthest = local.iter().map(|&(node, _)| length(points[node])).fold(0.0, f64::max);
        let limit = FARTHEST * self.spacing.max(self.search);
        if farthest > limit {
            return Err((
                format!("the nodes around it are {farthest:.6e} m away"),
                format!("at most {limit:.6e} m, {FARTHEST} times the distance between nodes"),
            ));
        }
        Ok(local.into_iter().map(|(node, weight)| (near[node].0, weight)).collect())
    }

    /// Weights for the origin if it lies outside the convex hull of `points`: extrapolation from the nearest triangle.
    fn extrapolated(&self, points: &[[f64; 2]]) -> Result<Vec<(usize, f64)>, (String, String)> {
        let clamped = nearest_on_hull(points);
        if length(clamped) > self.search {
            return Err((
                format!("it lies {:.6e} m outside the surface", length(clamped)),
                format!("at most {:.6e} m (search_distance_m)", self.search),
            ));
        }
        // The nearest hull point, moved slightly inwards so that the triangle at that edge contains it.
        let count = points.len() as f64;
        let centre = points.iter().fold([0.0; 2], |sum, p| [sum[0] + p[0] / count, sum[1] + p[1] / count]);
        let around = |origin: [f64; 2]| -> Option<Vec<(usize, f64)>> {
            inside(&points.iter().map(|p| [p[0] - origin[0], p[1] - origin[1]]).collect::<Vec<_>>())
        };
        let inner = [0, 1].map(|axis| clamped[axis] + 1e-6 * (centre[axis] - clamped[axis]));
        if let Some(triangle) = around(inner)
            && let &[(a, _), (b, _), (c, _)] = triangle.as_slice()
        {
            let weights = barycentric([points[a], points[b], points[c]], [0.0; 2]);
            if weights.iter().all(|weight| weight.abs() <= LARGEST_WEIGHT) {
                return Ok(vec![(a, weights[0]), (b, weights[1]), (c, weights[2])]);
            }
        }
        // The nodes are collinear or the triangle is a sliver: take the nearest point of the surface instead.
        let weights = around(clamped).or_else(|| around(inner));
        weights.ok_or_else(|| ("no nodes surround it".to_owned(), "nodes that span a surface".to_owned()))
    }
}

fn length(a: [f64; 2]) -> f64 {
    a[0].hypot(a[1])
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    length([a[0] - b[0], a[1] - b[1]])
}

/// Twice the signed area of a triangle, positive if its corners run anticlockwise.
fn area(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// Barycentric coordinates of `at` in a triangle.
fn barycentric([a, b, c]: [[f64; 2]; 3], at: [f64; 2]) -> [f64; 3] {
    let whole = area(a, b, c);
    let (first, second) = (area(at, b, c) / whole, area(at, c, a) / whole);
    [first, second, 1.0 - first - second]
}

/// Weights of the Delaunay triangle that contains the origin; `None` if no triangle does.
///
/// Simplex method with a lexicographic cost: first the weight on three artificial far points, which are the initial
/// basis, then `Σ w |x|²`.
fn inside(points: &[[f64; 2]]) -> Option<Vec<(usize, f64)>> {
    let reach = points.iter().map(|p| length(*p)).fold(0.0, f64::max);
    if reach == 0.0 {
        return (!points.is_empty()).then(|| vec![(0, 1.0)]);
    }
    let count = points.len();
    let unit: Vec<[f64; 2]> = points.iter().map(|p| [p[0] / reach, p[1] / reach]).collect();
    let far = [[0.0, 4.0], [-3.4641, -2.0], [3.4641, -2.0]];
    let at = |j: usize| if j < count { unit[j] } else { far[j - count] };
    let cost = |j: usize| if j < count { [0.0, unit[j][0].powi(2) + unit[j][1].powi(2)] } else { [1.0, 0.0] };

    let mut basis = [count, count + 1, count + 2];
    for _ in 0..100 * (count + 3) {
        let corners = basis.map(at);
        let weights = barycentric(corners, [0.0; 2]);
        // Bland's rule: the first node (nearest first) that lowers the cost enters; of the corners that reach zero
        // first, the one with the lowest index leaves.
        let entering = (0..count).filter(|j| !basis.contains(j)).find_map(|j| {
            let beta = barycentric(corners, at(j));
            let gain = |rank: usize| cost(j)[rank] - (0..3).map(|i| beta[i] * cost(basis[i])[rank]).sum::<f64>();
            let first = gain(0);
            (first < -1e-12 || (first < 1e-12 && gain(1) < -1e-12)).then_some((j, beta))
        });
        let Some((entering, beta)) = entering else { break };
        let leaving = (0..3).filter(|&i| beta[i] > 1e-12).min_by(|&a, &b| {
            let ratio = |i: usize| weights[i].max(0.0) / beta[i];
            ratio(a).total_cmp(&ratio(b)).then(basis[a].cmp(&basis[b]))
        })?;
        basis[leaving] = entering;
    }
    let weights = barycentric(basis.map(at), [0.0; 2]);
    let outside: f64 = (0..3).filter(|&i| basis[i] >= count).map(|i| weights[i].abs()).sum();
    if outside > 1e-12 || weights.iter().any(|weight| weight.is_nan() || *weight < -1e-9) {
        return None;
    }
    let kept: Vec<(usize, f64)> =
        (0..3).filter(|&i| basis[i] < count && weights[i] > 1e-14).map(|i| (basis[i], weights[i])).collect();
    let sum: f64 = kept.iter().map(|(_, weight)| weight).sum();
    Some(kept.into_iter().map(|(node, weight)| (node, weight / sum)).collect())
}

/// The point of the convex hull of `points` nearest to the origin, which lies outside it (Andrew's monotone chain).
fn nearest_on_hull(points: &[[f64; 2]]) -> [f64; 2] {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let mut hull: Vec<[f64; 2]> = vec![];
    for pass in 0..2 {
        let start = hull.len();
        for &point in &sorted {
            while hull.len() >= start + 2 && area(hull[hull.len() - 2], hull[hull.len() - 1], point) <= 0.0 {
                hull.pop();
            }
            hull.push(point);
        }
        if pass == 0 {
            sorted.reverse();
        }
    }
    let mut best = points.first().copied().unwrap_or([0.0; 2]);
    for edge in hull.windows(2) {
        let (a, b) = (edge[0], edge[1]);
        let along = [b[0] - a[0], b[1] - a[1]];
        let squared = along[0].powi(2) + along[1].powi(2);
        let s = if squared > 0.0 { (-(a[0] * along[0] + a[1] * along[1]) / squared).clamp(0.0, 1.0) } else { 0.0 };
        let candidate = [a[0] + s * along[0], a[1] + s * along[1]];
        if length(candidate) < length(best) {
            best = candidate;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn surface(points: &[[f64; 2]], search: Option<f64>) -> Interpolation {
        let nodes: Vec<[f64; 3]> = points.iter().map(|p| [p[0], p[1], 0.02]).collect();
        Interpolation::new(&nodes, Plane::across([0.0, 0.0, 1.0]), search)
    }

    fn grid() -> Vec<[f64; 2]> {
        (0..6).flat_map(|i| (0..5).map(move |j| [0.01 * i as f64, 0.012 * j as f64])).collect()
    }

    #[test]
    fn linear_fields_are_exact_inside_on_edges_and_outside() {
        let points = grid();
        let interpolation = surface(&points, None);
        let field = |p: [f64; 2]| 3.0 + 7.0 * p[0] - 2.0 * p[1];
        for at in [
            [0.0123, 0.0301],
            [0.01, 0.006],
            [0.005, 0.0],
            [0.05, 0.048],
            [0.02, 0.024],
            [0.0525, 0.02],
            [-0.003, -0.002],
        ] {
            let weights = interpolation.weights([at[0], at[1], 0.02]).unwrap();
            let sum: f64 = weights.iter().map(|w| w.1).sum();
            let value: f64 = weights.iter().map(|&(node, w)| w * field(points[node])).sum();
            assert!((sum - 1.0).abs() < 1e-14 && (value - field(at)).abs() < 1e-13, "{at:?} {weights:?}");
            assert!(weights.iter().all(|&(node, _)| distance(points[node], at) < 0.02), "{at:?} {weights:?}");
        }
    }

    #[test]
    fn the_triangle_is_delaunays() {
        // By definition, no node lies inside the circumcircle of a Delaunay triangle. Checked for every node.
        let mut state = 7_u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / (1_u64 << 31) as f64
        };
        let points: Vec<[f64; 2]> = (0..60).map(|_| [random(), random()]).collect();
        let mut checked = 0;
        for _ in 0..200 {
            let at = [random(), random()];
            let relative: Vec<[f64; 2]> = points.iter().map(|p| [p[0] - at[0], p[1] - at[1]]).collect();
            let Some(weights) = inside(&relative) else { continue };
            let &[(a, _), (b, _), (c, _)] = weights.as_slice() else { panic!("{weights:?}") };
            let (mut a, b, mut c) = (points[a], points[b], points[c]);
            if area(a, b, c) < 0.0 {
                std::mem::swap(&mut a, &mut c);
            }
            for p in &points {
                let row = |q: [f64; 2]| [q[0] - p[0], q[1] - p[1], (q[0] - p[0]).powi(2) + (q[1] - p[1]).powi(2)];
                assert!(dot(row(a), cross(row(b), row(c))) < 1e-12);
            }
            checked += 1;
        }
        assert!(checked > 150);
    }

    #[test]
    fn too_far_is_refused_with_the_distance() {
        let interpolation = surface(&grid(), Some(0.002));
        let (value, limit) = interpolation.weights([0.06, 0.02, 0.02]).unwrap_err();
        assert_eq!(value, "it lies 1.000000e-2 m outside the surface");
        assert_eq!(limit, "at most 2.000000e-3 m (search_distance_m)");
        let (value, _) = interpolation.weights([0.02, 0.02, 0.03]).unwrap_err();
        assert_eq!(value, "the nearest node along the normal is 1.000000e-2 m away");
    }

    #[test]
    fn nodes_on_a_line_carry_points_on_it() {
        let interpolation = surface(&[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], None);
        assert_eq!(interpolation.weights([1.25, 0.0, 0.02]).unwrap(), [(1, 0.75), (2, 0.25)]);
    }
}
