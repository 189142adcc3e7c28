//! Contact forces of a pad pressed askew on a disc, without friction, against CalculiX on the same mesh with springs that
//! only push.

use std::fmt::Write;
use std::path::Path;
use std::process::Command;

use crate::program;
use squealcast::contact::{MeasuredLoad, PressureLaw, Statics, StaticsParts};
use squealcast::export::write_deck;
use squealcast::fem::{Block, Material, Mesh, SOLID, Spring, Structure};
use squealcast::physics::ContactLaw;
use squealcast::reduction::{FullContact, FullModel, FullPart, SparseRow};

/// Forces here are in µN, and moduli and stiffnesses accordingly a million times as large: CalculiX takes forces below about 1e-9
/// to be in balance.
const STEEL: Material = Material { density_kg_per_m3: 7800.0, young_pa: 210e15, poisson: 0.27 };
const LINING: Material = Material { density_kg_per_m3: 4500.0, young_pa: 2e15, poisson: 0.29 };
/// Bricks along each side of the patch.
const CELLS: usize = 4;
/// Stiffness of a pair, µN/m: its closure is of the size of the pad's deformation, so that the seven digits of CalculiX's
/// displacements are digits of the forces.
const STIFFNESS: f64 = 1e12;
/// Holders at the pad's back, µN/m per node: without them CalculiX has no supported start.
const HOLDER: f64 = 1e10;
/// µN. CalculiX solves nonlinear springs with large displacements only; strains of 1e-11 keep these out of the result.
const LOAD: f64 = 1e3;
/// Every pair begins with this closure, m, of 4e-11 under the load: springs that are all open have no stiffness to begin
/// with.
const CLOSED_AT_FIRST: f64 = 1e-13;

fn lines([from, to]: [f64; 2], cells: usize) -> Vec<f64> {
    (0..=cells).map(|k| from + (to - from) * k as f64 / cells as f64).collect()
}

fn add_box(mesh: &mut Mesh, name: &str, material: Material, heights: [f64; 2], layers: usize) -> Block {
    let component = mesh.add_component(name, material);
    let side = lines([0.012, 0.048], CELLS);
    mesh.add_block(component, [side.clone(), lines(heights, layers), side], SOLID, &[], |at| at)
}

fn level(block: &Block, level: usize) -> Vec<usize> {
    (0..=CELLS).flat_map(|k| (0..=CELLS).map(move |i| (i, k))).map(|(i, k)| block.node([i, level, k])).collect()
}

/// Displacements along y that CalculiX lists last, by node.
fn displacements(dat: &Path, nodes: usize) -> Vec<f64> {
    let text = std::fs::read_to_string(dat).expect("a .dat file");
    let table = text.rsplit("displacements").next().expect("a table");
    let rows: Vec<f64> = table
        .lines()
        .filter_map(|line| {
            let words: Vec<&str> = line.split_whitespace().collect();
            (words.len() == 4).then(|| words[2].parse().ok()).flatten()
        })
        .collect();
    assert_eq!(rows.len(), nodes, "{text}");
    rows
}

#[test]
fn calculix_finds_the_same_contact_forces() {
    if Command::new("ccx").arg("-v").output().is_err() {
        return program::skipped("there is no ccx (Debian package calculix-ccx)");
    }
    let mut structure = Structure::default();
    let disc = add_box(&mut structure.mesh, "disc", STEEL, [-0.012, 0.0], 1);
    let pad = add_box(&mut structure.mesh, "pad", LINING, [0.0, 0.012], 2);
    let back = level(&pad, 2);
    structure.fixed.extend(level(&disc, 0).into_iter().flat_map(|node| [0, 1, 2].map(|axis| (node, axis))));
    structure.fixed.extend(back.iter().flat_map(|&node| [(node, 0), (node, 2)]));
    structure.springs =
        back.iter().map(|&node| Spring { node, other: None, direction: 1, stiffness_n_per_m: HOLDER }).collect();
    // Most of the load at the edge x = 0.012 m, more towards z = 0.048 m; a sum of 1.
    let share = |node: usize| {
        let [x, _, z] = structure.mesh.nodes_m[node];
        (if x < 0.0121 { 1.6 } else { 0.02 }) * (1.0 + (z - 0.012) / 0.045)
    };
    let total: f64 = back.iter().map(|&node| share(node)).sum();

    let assembled = structure.assemble().expect("matrices");
    let row = |node: usize| assembled.rows.binary_search(&(node, 1)).expect("a free degree of freedom");
    let pairs: Vec<(usize, usize)> = level(&pad, 0).into_iter().zip(level(&disc, 1)).collect();
    let normal: Vec<SparseRow> = pairs.iter().map(|&(pad, disc)| vec![(row(pad), 1.0), (row(disc), -1.0)]).collect();
    let count = pairs.len();
    let contact = FullContact { sliding: vec![vec![]; count], normal, ..FullContact::default() };
    let part = FullPart { name: "blocks".to_owned(), mass: assembled.mass, stiffness: assembled.stiffness };
    let model = FullModel {
        parts: vec![part],
        stiffness: vec![],
        damping: vec![],
        contact: Some(contact),
        modal_damping: vec![],
        contact_law: ContactLaw::default(),
    };
    let load: SparseRow = back.iter().map(|&node| (row(node), -share(node) / total)).collect();
    let statics = Statics::new(StaticsParts {
        law: PressureLaw::Linear { stiffness: STIFFNESS },
        area: vec![1.0; count],
        gap_m: vec![-CLOSED_AT_FIRST; count],
        response: model
            .static_response(&squealcast::reduction::OwnEngine, &load, None)
            .expect("a response")
            .expect("a contact"),
        measured: MeasuredLoad::Back,
    })
    .expect("valid statics");
    let state = statics.state(LOAD, 0.0).expect("a state");

    let mut deck = vec![];
    write_deck(&structure, "pad on disc", 1, &mut deck).expect("a deck");
    let deck = String::from_utf8(deck).expect("text");
    let mut deck = deck.split("*STEP").next().expect("the mesh").to_owned();
    deck += "*ELEMENT, TYPE=SPRING2, ELSET=pairs\n";
    let first = structure.mesh.bricks.len() + structure.springs.len() + 1;
    for (index, (pad, disc)) in pairs.iter().enumerate() {
        writeln!(deck, "{}, {}, {}", first + index, pad + 1, disc + 1).unwrap();
    }
    let far = 1e-5;
    writeln!(
        deck,
        "*SPRING, ELSET=pairs, NONLINEAR\n2, 2\n{:.12e}, {:.12e}\n0., {CLOSED_AT_FIRST:.12e}\n0., 1.0",
        -STIFFNESS * (far + CLOSED_AT_FIRST),
        -far
    )
    .unwrap();
    // Each iteration of CalculiX leaves 0.94 of the error: it needs hundreds, and no smaller increments.
    deck += "*STEP, INC=10000, NLGEOM\n*STATIC\n0.25, 1.\n*CONTROLS, PARAMETERS=FIELD\n1e-8, 1e-6, , , 1e-8, , ,\n\
             *CONTROLS, PARAMETERS=TIME INCREMENTATION\n1000, 2000, 9, 5000, 10, 4, , 30, , \n*CLOAD\n";
    for &node in &back {
        writeln!(deck, "{}, 2, {:.12e}", node + 1, -LOAD * share(node) / total).unwrap();
    }
    deck += "*NODE PRINT, NSET=ALL\nU\n*END STEP\n";
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("pressed.inp"), deck).expect("a deck");
    let ended = Command::new("ccx").arg("pressed").current_dir(folder.path()).output().expect("ccx");
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stdout));
    let moved = displacements(&folder.path().join("pressed.dat"), structure.mesh.nodes_m.len());
    let forces: Vec<f64> =
        pairs.iter().map(|&(pad, disc)| STIFFNESS * (CLOSED_AT_FIRST - moved[pad] + moved[disc]).max(0.0)).collect();

    let holders: f64 = back.iter().map(|&node| -HOLDER * moved[node]).sum();
    let left = (forces.iter().sum::<f64>() + holders) / LOAD - 1.0;
    assert!(left.abs() < 1e-6, "CalculiX leaves {left:e} of the load out of balance");
    let largest = forces.iter().copied().fold(0.0, f64::max);
    let off =
        forces.iter().zip(&state.force_n).map(|(theirs, ours)| (theirs - ours).abs()).fold(0.0, f64::max) / largest;
    let closed = forces.iter().filter(|force| **force > 0.0).count();
    eprintln!("{closed} of {count} pairs closed; forces differ by {off:.1e} of the largest, {largest:.3e} µN");
    assert!((2..count).contains(&closed), "{closed} of {count} pairs are closed: nothing opens");
    for (index, (theirs, ours)) in forces.iter().zip(&state.force_n).enumerate() {
        assert_eq!(*theirs > 0.0, *ours > 0.0, "pair {index}: {theirs:e} µN, ours {ours:e} µN");
    }
    assert!(off < 1e-6, "forces differ by {off:e} of the largest");
}
