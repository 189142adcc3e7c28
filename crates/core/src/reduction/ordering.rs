//! Fill-reducing ordering of a sparse symmetric matrix by nested dissection.
//!
//! Rows with the same neighbours, such as the degrees of freedom of one node, are eliminated together. The graph to
//! dissect has one vertex per such group, a third of the rows of a solid mesh, and gives the fill of the mesh.
//!
//! Source: George, "Nested dissection of a regular finite element mesh", SIAM J. Numer. Anal. 10 (1973) 345-363;
//! Karypis, Kumar, "A fast and high quality multilevel scheme for partitioning irregular graphs", SIAM J. Sci. Comput.
//! 20 (1998) 359-392.

use std::collections::HashMap;

use faer::perm::Perm;
use feral_metis::CscPattern;

/// Writes the neighbours of a row into a vector: ascending, the row itself included.
pub(super) type Neighbours<'a> = dyn Fn(usize, &mut Vec<usize>) + 'a;

/// The permutation that eliminates `n` rows in nested-dissection order; `neighbours` describes a symmetric pattern.
///
/// # Errors
/// The reason, if the graph is too large, unsymmetric or rejected by the partitioner.
pub(super) fn nested_dissection(n: usize, neighbours: &Neighbours<'_>) -> Result<Perm<usize>, String> {
    let (group_of, members) = groups(n, neighbours);
    let mut row = vec![];
    let mut graph: Vec<Vec<i32>> = members
        .iter()
        .map(|group| {
            neighbours(group[0], &mut row);
            let mut seen: Vec<i32> = row.iter().map(|&other| group_of[other] as i32).collect();
            seen.sort_unstable();
            seen.dedup();
            seen
        })
        .collect();
    complete(&mut graph);
    let (mut starts, mut adjacent) = (vec![0_i32], vec![]);
    for seen in &graph {
        adjacent.extend_from_slice(seen);
        starts.push(i32::try_from(adjacent.len()).map_err(|_| "its graph has more than 2^31 edges".to_owned())?);
    }
    let graph = CscPattern::new(members.len(), &starts, &adjacent).ok_or("its pattern is not symmetric")?;
    let order = feral_metis::metis_order(&graph).map_err(|error| format!("nested dissection failed: {error:?}"))?;
    let forward: Vec<usize> = order.iter().flat_map(|&group| members[group as usize].iter().copied()).collect();
    let mut inverse = vec![0; n];
    for (position, &row) in forward.iter().enumerate() {
        inverse[row] = position;
    }
    Ok(Perm::new_checked(forward.into(), inverse.into(), n))
}

/// Adds the reverse of one-way edges. They occur in symmetric matrices that store an explicit zero in one triangle
/// only. Dissection requires a symmetric graph.
fn complete(graph: &mut [Vec<i32>]) {
    let mut missing = vec![];
    for (from, seen) in graph.iter().enumerate() {
        let back = |to: &&i32| graph[**to as usize].binary_search(&(from as i32)).is_err();
        missing.extend(seen.iter().filter(back).map(|&to| (to as usize, from as i32)));
    }
    for (from, to) in missing {
        if let Err(at) = graph[from].binary_search(&to) {
            graph[from].insert(at, to);
        }
    }
}

/// Groups rows with equal neighbours: the group of every row, and the rows of every group.
fn groups(n: usize, neighbours: &Neighbours<'_>) -> (Vec<usize>, Vec<Vec<usize>>) {
    let (mut group_of, mut members) = (vec![0; n], Vec::<Vec<usize>>::new());
    let mut by_hash: HashMap<u64, Vec<usize>> = HashMap::new();
    let (mut row_neighbours, mut other) = (vec![], vec![]);
    for (row, group_of) in group_of.iter_mut().enumerate() {
        neighbours(row, &mut row_neighbours);
        let hash = row_neighbours.iter().fold(0xcbf2_9ce4_8422_2325_u64, |hash, &index| {
            (hash ^ index as u64).wrapping_mul(0x0100_0000_01b3).rotate_left(23)
        });
        let candidates = by_hash.entry(hash).or_default();
        let equal = candidates.iter().copied().find(|&group| {
            neighbours(members[group][0], &mut other);
            other == row_neighbours
        });
        *group_of = equal.unwrap_or(members.len());
        match equal {
            Some(group) => members[group].push(row),
            None => {
                candidates.push(members.len());
                members.push(vec![row]);
            }
        }
    }
    (group_of, members)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line of nodes with three rows each, numbered direction by direction.
    fn line(nodes: usize) -> impl Fn(usize, &mut Vec<usize>) {
        move |row, out| {
            let node = row % nodes;
            out.clear();
            for direction in 0..3 {
                let near = node.saturating_sub(1)..=(node + 1).min(nodes - 1);
                out.extend(near.map(|other| direction * nodes + other));
            }
        }
    }

    #[test]
    fn the_rows_of_a_node_stay_together() {
        let nodes = 1000;
        let order = nested_dissection(3 * nodes, &line(nodes)).unwrap();
        let (forward, inverse) = order.arrays();
        for three in forward.chunks(3) {
            assert!(three.iter().all(|row| row % nodes == three[0] % nodes), "{three:?}");
        }
        assert!((0..3 * nodes).all(|row| forward[inverse[row]] == row));
        // A line is cut in the middle: the rows eliminated last lie near there, not at an end.
        let last = forward[3 * nodes - 1] % nodes;
        assert!((nodes / 3..2 * nodes / 3).contains(&last), "{last}");
    }

    #[test]
    fn edges_that_are_there_one_way_only_are_completed() {
        let mut graph = vec![vec![0, 2], vec![0, 1], vec![2]];
        complete(&mut graph);
        assert_eq!(graph, [vec![0, 1, 2], vec![0, 1], vec![0, 2]]);
    }
}
