//! Decks of CalculiX and, except for the order of the springs, of Abaqus: nodes, `C3D8I` bricks, materials, supports,
//! springs, equations of hanging nodes, and a frequency step.

use std::collections::BTreeMap;
use std::io::{self, Write};

use crate::fem::{Spring, Structure};

/// Writes a structure as a deck that computes the `modes` lowest natural frequencies. Nodes and bricks count from 1;
/// units are SI. Numbers have 13 digits, because CalculiX reads at most 20 characters per field.
///
/// # Errors
/// Those of the writer.
pub fn write_deck(structure: &Structure, heading: &str, modes: usize, out: &mut impl Write) -> io::Result<()> {
    let mesh = &structure.mesh;
    writeln!(out, "*HEADING\n{heading}\n*NODE, NSET=ALL")?;
    for (node, [x, y, z]) in mesh.nodes_m.iter().enumerate() {
        writeln!(out, "{}, {x:.12e}, {y:.12e}, {z:.12e}", node + 1)?;
    }
    for (number, component) in mesh.components.iter().enumerate() {
        let name = &component.name;
        writeln!(out, "*ELEMENT, TYPE=C3D8I, ELSET={name}")?;
        for (index, brick) in mesh.bricks.iter().enumerate().filter(|(_, brick)| brick.component == number) {
            let nodes = brick.nodes.map(|node| (node + 1).to_string()).join(", ");
            writeln!(out, "{}, {nodes}", index + 1)?;
        }
        let material = component.material;
        writeln!(out, "*MATERIAL, NAME={name}\n*ELASTIC\n{:e}, {}", material.young_pa, material.poisson)?;
        writeln!(out, "*DENSITY\n{}\n*SOLID SECTION, ELSET={name}, MATERIAL={name}", material.density_kg_per_m3)?;
    }
    if !structure.fixed.is_empty() {
        writeln!(out, "*BOUNDARY")?;
        for (node, direction) in &structure.fixed {
            writeln!(out, "{}, {}, {}", node + 1, direction + 1, direction + 1)?;
        }
    }
    for (node, weights) in &mesh.hanging {
        for direction in 1..=3 {
            writeln!(out, "*EQUATION\n{}", weights.len() + 1)?;
            let terms: Vec<String> = [(*node, -1.0)]
                .iter()
                .chain(weights)
                .map(|(node, weight)| format!("{}, {direction}, {weight:.12e}", node + 1))
                .collect();
            // A line holds at most four terms.
            for line in terms.chunks(4) {
                writeln!(out, "{}", line.join(", "))?;
            }
        }
    }
    write_springs(&structure.springs, mesh.bricks.len(), out)?;
    writeln!(out, "*STEP\n*FREQUENCY\n{modes}\n*NODE FILE\nU\n*END STEP")
}

/// Key of identical springs: whether they join two nodes, their direction, the bits of their stiffness.
type Kind = (bool, usize, u64);

/// Writes springs, those with the same key as one set. Element numbers continue after the `bricks`.
fn write_springs(springs: &[Spring], bricks: usize, out: &mut impl Write) -> io::Result<()> {
    let mut alike: BTreeMap<Kind, Vec<(usize, &Spring)>> = BTreeMap::new();
    for (index, spring) in springs.iter().enumerate() {
        let key = (spring.other.is_some(), spring.direction, spring.stiffness_n_per_m.to_bits());
        alike.entry(key).or_default().push((index, spring));
    }
    for (set, ((joins, direction, stiffness), members)) in alike.into_iter().enumerate() {
        let kind = if joins { "SPRING2" } else { "SPRING1" };
        writeln!(out, "*ELEMENT, TYPE={kind}, ELSET=springs-{set}")?;
        for (index, spring) in members {
            let nodes: Vec<String> =
                [Some(spring.node), spring.other].iter().flatten().map(|node| (node + 1).to_string()).collect();
            writeln!(out, "{}, {}", bricks + index + 1, nodes.join(", "))?;
        }
        let directions = vec![(direction + 1).to_string(); if joins { 2 } else { 1 }].join(", ");
        writeln!(out, "*SPRING, ELSET=springs-{set}\n{directions}\n{:.12e}", f64::from_bits(stiffness))?;
    }
    Ok(())
}
