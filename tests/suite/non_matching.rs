//! A pad mesh finer than the disc's: through the interpolation `T` the interface converges to the one of meshes that match.

use std::f64::consts::TAU;
use std::fmt::Write;
use std::path::Path;

use crate::program::folder;
use squealcast::export::write_symmetric;
use squealcast::fem::{Block, Material, Mesh, SOLID, Structure};
use squealcast::full_model::FullModelFile;
use squealcast::reduction::{FullSolver, FullVectors};

const STEEL: Material = Material { density_kg_per_m3: 7800.0, young_pa: 210e9, poisson: 0.27 };
const LINING: Material = Material { density_kg_per_m3: 4500.0, young_pa: 20e9, poisson: 0.29 };
/// Where pad and disc lie along x and z, m; the pad covers 3 by 3 of the disc's 5 by 5 coarsest bricks.
const DISC: [f64; 2] = [0.0, 0.060];
const PAD: [f64; 2] = [0.012, 0.048];
/// Height of both, m.
const HEIGHT: f64 = 0.012;
/// Contact stiffness per area, N/m³: pad and contact by themselves would vibrate at 3 to 4 kHz.
const CONTACT: f64 = 2e10;
const FRICTION: f64 = 0.2;
/// Roots that are compared, and a band that holds them.
const ROOTS: usize = 5;
const BAND_HZ: f64 = 25_000.0;

fn lines([from, to]: [f64; 2], cells: usize) -> Vec<f64> {
    (0..=cells).map(|k| from + (to - from) * k as f64 / cells as f64).collect()
}

/// A box of bricks over `x`, `z` and between two heights.
fn boxed(material: Material, across: [f64; 2], cells: usize, heights: [f64; 2], layers: usize) -> (Structure, Block) {
    let mut mesh = Mesh::default();
    let component = mesh.add_component("box", material);
    let side = lines(across, cells);
    let block = mesh.add_block(component, [side.clone(), lines(heights, layers), side], SOLID, &[], |at| at);
    (Structure { mesh, ..Structure::default() }, block)
}

/// Nodes of a level of a block with the area that belongs to each, m².
fn level(block: &Block, level: usize) -> Vec<(usize, f64)> {
    let [x, _, z] = block.counts();
    let share = |axis: usize, k: usize| {
        let lines = block.lines(axis);
        0.5 * (lines[(k + 1).min(lines.len() - 1)] - lines[k.saturating_sub(1)])
    };
    (0..z).flat_map(|k| (0..x).map(move |i| (block.node([i, level, k]), share(0, i) * share(2, k)))).collect()
}

/// Writes a part of a full model; returns its table.
fn part(folder: &Path, name: &str, structure: &Structure, interface: &[usize]) -> String {
    let assembled = structure.assemble().unwrap();
    let file = |what: &str| folder.join(format!("{name}-{what}"));
    for (what, matrix) in [("K.mtx", &assembled.stiffness), ("M.mtx", &assembled.mass)] {
        write_symmetric(matrix, name, &mut std::fs::File::create(file(what)).unwrap()).unwrap();
    }
    let mut nodes = "x_m,y_m,z_m\n".to_owned();
    structure.mesh.nodes_m.iter().for_each(|[x, y, z]| writeln!(nodes, "{x:e},{y:e},{z:e}").unwrap());
    std::fs::write(file("nodes.csv"), nodes).unwrap();
    let mut rows = "node,direction\n".to_owned();
    assembled.rows.iter().for_each(|&(node, axis)| writeln!(rows, "{node},{}", ["x", "y", "z"][axis]).unwrap());
    std::fs::write(file("rows.csv"), rows).unwrap();
    format!(
        "[{name}]\nstiffness = \"{name}-K.mtx\"\nmass = \"{name}-M.mtx\"\nnodes = \"{name}-nodes.csv\"\n\
         rows = \"{name}-rows.csv\"\ninterface_nodes = {interface:?}\n"
    )
}

/// The lowest roots, `λ²` over `(2π)²`, of a pad with `pad_cells` bricks along each side on a disc whose bricks are `1/n` of the
/// coarsest; and how many pairs of coincident nodes and of interpolated ones there are.
fn squares(n: usize, pad_cells: usize) -> (Vec<f64>, [usize; 2]) {
    let folder = folder();
    let (mut disc, lower) = boxed(STEEL, DISC, 5 * n, [-HEIGHT, 0.0], n);
    // Clamped along its four sides.
    for (node, place) in disc.mesh.nodes_m.iter().enumerate() {
        if [place[0], place[2]].iter().any(|x| DISC.contains(x)) {
            disc.fixed.extend([0, 1, 2].map(|axis| (node, axis)));
        }
    }
    let (mut pad, upper) = boxed(LINING, PAD, pad_cells, [0.0, HEIGHT], pad_cells / 3);
    // Guided at its top.
    for (node, _) in level(&upper, pad_cells / 3) {
        pad.fixed.extend([(node, 0), (node, 2)]);
    }
    let interface = level(&upper, 0);
    let stiffness: Vec<f64> = interface.iter().map(|(_, area)| CONTACT * area).collect();
    let nodes = |nodes: &[(usize, f64)]| nodes.iter().map(|(node, _)| *node).collect::<Vec<usize>>();
    let toml = format!(
        "name = \"blocks\"\n[band]\nmax_hz = {BAND_HZ:?}\n{}{}[[contact_patch]]\naxis_point_m = [-0.1, 0.0, 0.03]\n\
         axis_direction = [0.0, 1.0, 0.0]\nnormal = [0.0, 1.0, 0.0]\nstiffness_n_per_m = {stiffness:?}\n",
        part(folder.path(), "pad", &pad, &nodes(&interface)),
        part(folder.path(), "disc", &disc, &nodes(&level(&lower, n))),
    );
    let path = folder.path().join("blocks.toml");
    std::fs::write(&path, toml).unwrap();
    let full = FullModelFile::load(&path).unwrap();
    let coincident = full.pairs.iter().filter(|pair| pair.disc.len() == 1).count();
    let p = full.settings.reference.with_friction(FRICTION);
    let mut solver = FullSolver::new("blocks", &full.model, None, &mut |_| {}).unwrap();
    let found = solver.roots(&p, TAU * BAND_HZ, FullVectors::None, &mut |_| {}).unwrap();
    let squares: Vec<f64> =
        found.roots.iter().take(ROOTS).map(|root| -(root.lambda * root.lambda).re / TAU.powi(2)).collect();
    assert_eq!(squares.len(), ROOTS);
    (squares, [coincident, full.pairs.len() - coincident])
}

/// Three meshes, each with bricks half as large. Pads of 5 bricks where the disc has 3 meet it at the corners alone; everything else
/// goes through `T`. Both ways converge to the same roots.
///
/// Bricks and bilinear interpolation are of second order where the solution is smooth; at the rim of the patch the pressure jumps,
/// which costs up to half an order of it. Where the remaining error falls by `q` a step, with `q` of at least 2^1.5 = 2.8, what is
/// left after the finest mesh is at most the last step over `q - 1 = 1.8`.
#[test]
fn a_finer_pad_through_t_converges_to_meshes_that_match() {
    let meshes = [1, 2, 4];
    let [matching, finer] = [3, 5].map(|cells| {
        meshes.map(|n| {
            let (squares, pairs) = squares(n, cells * n);
            eprintln!(
                "{n}: {} coincident pairs, {} through T: {:.2?} Hz",
                pairs[0],
                pairs[1],
                squares.iter().map(|square| square.sqrt()).collect::<Vec<_>>()
            );
            let corners_alone = (cells == 5 && pairs[1] > 0) || (cells == 3 && pairs[1] == 0);
            assert!(corners_alone, "{pairs:?}");
            squares
        })
    });
    for root in 0..ROOTS {
        let between: Vec<f64> = (0..3).map(|k| (finer[k][root] / matching[k][root] - 1.0).abs()).collect();
        let orders: Vec<f64> = between.windows(2).map(|pair| (pair[0] / pair[1]).log2()).collect();
        eprintln!("root {root}: finer pad against matching meshes {between:?}, orders {orders:.2?}");
        assert!(between[0] > between[1] && between[1] > between[2], "{between:?}");
        let left = |of: &[Vec<f64>; 3]| (of[2][root] - of[1][root]).abs() / 1.8;
        let apart = (finer[2][root] - matching[2][root]).abs();
        assert!(apart <= left(&finer) + left(&matching), "root {root}: {apart:e}");
    }
}
