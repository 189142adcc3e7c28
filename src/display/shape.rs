//! The shape of a mode at an operating point: displacements of the rig's degrees of freedom or interface nodes.
//!
//! A mode moves as `Re(x e^{λt})`. With `x = |x| e^{iφ}` a point moves as `|x| cos(ωt + φ)`, so a point with larger
//! phase leads.

use faer::{MatRef, c64};
use serde::Serialize;

use super::change::GrowthChange;
use crate::physics::{OperatingPoint, Solver, StabilityMap, Vectors};
use crate::rig::{DiscAxis, Rig};
use crate::session::numbers;

/// The shape of a mode, scaled so that the largest displacement has magnitude 1 and phase 0.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Shape {
    pub id: u32,
    pub frequency_hz: f64,
    pub growth_rate_per_s: f64,
    /// The pad's share of the motion; `null` if the rig does not distinguish pad and disc.
    pub pad_share: Option<f64>,
    /// Sensitivity of the growth rate to conditions and contact; `null` if unknown.
    pub growth_change: Option<GrowthChange>,
    /// The axis of rotation of the disc, for drawing its outline.
    pub disc: Option<DiscAxis>,
    /// Pad and disc, or the whole system.
    pub parts: Vec<Part>,
}

/// Displacements of one part.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Part {
    pub name: String,
    /// Whether the displacements are those of nodes in space, three for each node, or of numbered degrees of freedom.
    pub spatial: bool,
    /// Positions of the nodes, m.
    pub nodes_m: Vec<[f64; 3]>,
    pub re: Vec<f64>,
    pub im: Vec<f64>,
}

/// The shape of the mode with identity `id`.
///
/// # Errors
/// Why it cannot be computed, as text.
pub fn shape(
    rig: &Rig,
    solver: &mut Solver,
    map: Option<&StabilityMap>,
    point: &OperatingPoint,
    id: u32,
) -> Result<Shape, String> {
    let spectrum = solver.solve(&rig.model, point, Vectors::Right).map_err(|error| error.to_string())?;
    let index = match map.filter(|map| numbers(&rig.model, map, point)) {
        Some(map) => map.ids(&spectrum).iter().position(|&other| other == Some(id)),
        None => Some(id as usize),
    };
    let index = index.filter(|&index| index < spectrum.mode_count).ok_or_else(|| format!("there is no mode {id}"))?;
    let root = &spectrum.roots[index];
    let mut parts = parts(rig, spectrum.shapes.as_ref(), index);
    let all = || parts.iter().flat_map(|part| part.re.iter().zip(&part.im)).map(|(&re, &im)| c64::new(re, im));
    let largest = all().max_by(|a, b| a.norm().total_cmp(&b.norm())).filter(|value| value.norm() > 0.0);
    if let Some(largest) = largest {
        for part in &mut parts {
            for (re, im) in part.re.iter_mut().zip(&mut part.im) {
                let scaled = c64::new(*re, *im) / largest;
                (*re, *im) = (scaled.re, scaled.im);
            }
        }
    }
    let (frequency_hz, growth_rate_per_s) = (root.frequency_hz(), root.growth_rate_per_s());
    let pad_share = Some(root.pad_participation).filter(|share| share.is_finite());
    let growth_change = GrowthChange::new(&rig.model, &spectrum, index).ok();
    Ok(Shape { id, frequency_hz, growth_rate_per_s, pad_share, growth_change, disc: rig.disc_axis, parts })
}

fn parts(rig: &Rig, shapes: MatRef<'_, c64>, column: usize) -> Vec<Part> {
    if rig.shapes.is_empty() {
        let x: Vec<c64> = (0..shapes.nrows()).map(|k| shapes[(k, column)]).collect();
        return vec![part("coordinates", vec![], &x)];
    }
    rig.shapes
        .iter()
        .map(|side| {
            let displacement = |row: usize| {
                (0..side.phi.ncols())
                    .map(|k| shapes[(side.first_coordinate + k, column)] * side.phi[(row, k)])
                    .fold(c64::new(0.0, 0.0), |sum, term| sum + term)
            };
            let u: Vec<c64> = (0..side.phi.nrows()).map(displacement).collect();
            part(side.name, side.nodes_m.clone(), &u)
        })
        .collect()
}

fn part(name: &str, nodes_m: Vec<[f64; 3]>, values: &[c64]) -> Part {
    Part {
        name: name.to_owned(),
        spatial: !nodes_m.is_empty(),
        nodes_m,
        re: values.iter().map(|value| value.re).collect(),
        im: values.iter().map(|value| value.im).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::RigFile;

    /// One mass on a belt: beyond the merging point the equation of motion gives `x₁/x₂` in closed form.
    #[test]
    fn the_shape_of_one_mass_on_a_belt_is_the_closed_form() {
        let text = include_str!("../../launch/rigs/hoffmann.toml");
        let rig = Rig::from_files(&[RigFile { name: "hoffmann.toml".to_owned(), bytes: text.into() }]).unwrap();
        let mut solver = Solver::new(2);
        let mu = 0.8;
        let point = rig.reference.with_friction(mu);
        let spectrum = solver.solve(&rig.model, &point, Vectors::Right).unwrap();
        let (id, root) =
            spectrum.modes().iter().enumerate().max_by(|a, b| a.1.lambda.re.total_cmp(&b.1.lambda.re)).unwrap();
        assert!(root.lambda.re > 0.0, "it flutters there");
        let shape = shape(&rig, &mut solver, None, &point, id as u32).unwrap();
        assert!(
            shape.pad_share.is_some_and(|share| (share - 1.0).abs() < 1e-12),
            "the belt is rigid: only the mass moves"
        );
        assert_eq!(shape.disc, None);
        let u: Vec<c64> = shape.parts[0].re.iter().zip(&shape.parts[0].im).map(|(&re, &im)| c64::new(re, im)).collect();
        // First row of the equation of motion, equation (3) of the paper: λ² x + k11 x + (k12 ± μ kn) y = 0. The belt
        // runs along +x and the normal is -y, so the friction force on the mass is -μ kn y.
        let k12 = 0.75 - mu * 4.0 / 3.0;
        let ratio = -(root.square + c64::from(1.5)) / k12;
        let found = u[1] / u[0];
        assert!((found - ratio).norm() < 1e-9 * ratio.norm(), "{found} {ratio}");
        assert!(u.iter().any(|u| (u - c64::new(1.0, 0.0)).norm() < 1e-12), "scaled to 1");
    }

    #[test]
    fn the_shape_of_an_embedded_tribometer_has_named_parts_a_pad_share_and_the_axis_of_the_disc() {
        let rig = Rig::load("tribometer").unwrap();
        let mut solver = Solver::new(rig.model.dimension());
        let shape = shape(&rig, &mut solver, None, &rig.reference, 0).unwrap();
        let names: Vec<&str> = shape.parts.iter().map(|part| part.name.as_str()).collect();
        assert_eq!(names, ["pad", "disc"]);
        assert!(shape.pad_share.is_some_and(|share| (0.0..=1.0).contains(&share)), "{:?}", shape.pad_share);
        // As in `launch/rigs/tribometer.toml`.
        let up = [0.0, 1.0, 0.0];
        let axis = DiscAxis { axis_point_m: [0.0; 3], axis_direction: up, normal: up };
        assert_eq!(shape.disc, Some(axis));
    }
}
