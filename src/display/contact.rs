//! The contact at an operating point, for rigs with a contact state: the force of every pair and its place.
//!
//! Pairs are placed in the plane of the disc, seen so that the disc moves from left to right below the pad: the leading
//! edge of the pad, where the disc moves under it, is on the left, and the outer radius above.

use serde::Serialize;

use crate::figures::contact::Dot;
use crate::physics::OperatingPoint;
use crate::rig::{DiscAxis, PairPlace, Rig};

/// The contact at an operating point.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Contact {
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
    /// Number of pairs that carry a force.
    pub pairs_closed: usize,
    /// Sum of the contact forces, N.
    pub contact_force_n: f64,
    /// Force on the back of the pad, N.
    pub back_force_n: f64,
    /// Force of each pair, N; 0 where it is open.
    pub force_n: Vec<f64>,
    /// Place of each pair; empty if the rig file gives none.
    pub places: Vec<Place>,
}

/// Place of a pair in the plane of the disc.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Place {
    /// Along the motion of the disc, from the middle of the patch, m.
    pub along_m: f64,
    /// Away from the axis of the disc, from the middle of the patch, m.
    pub outward_m: f64,
    /// Whether the pair is on the face of the disc opposite to the first pair.
    pub opposite: bool,
}

impl Contact {
    /// The pairs as figures show them: one for each face of the disc.
    pub fn faces(&self) -> Vec<Vec<Dot>> {
        let place = |pair: usize| self.places.get(pair).map(|place| (1e3 * place.along_m, 1e3 * place.outward_m));
        let mut faces = [vec![], vec![]];
        for (pair, &force_n) in self.force_n.iter().enumerate() {
            let opposite = self.places.get(pair).is_some_and(|place| place.opposite);
            faces[usize::from(opposite)].push(Dot { place_mm: place(pair), force_n });
        }
        faces.into_iter().filter(|dots| !dots.is_empty()).collect()
    }
}

/// The contact of `rig` at `point`.
///
/// # Errors
/// Why there is none, as text: a rig without a contact state, no load, or no state of steady sliding.
pub fn contact(rig: &Rig, point: &OperatingPoint) -> Result<Contact, String> {
    if rig.model.statics().is_none() {
        return Err("the contact pairs of this rig are always closed".to_owned());
    }
    let here = rig.model.at(point).map_err(|error| error.to_string())?;
    let state = here.state().ok_or("contact open: no normal load")?;
    let known = rig.contact.as_ref().zip(rig.disc_axis.as_ref());
    let backward = point.disc_speed_rad_s < 0.0;
    Ok(Contact {
        normal_load_n: point.normal_load_n,
        disc_speed_rad_s: point.disc_speed_rad_s,
        friction_coefficient: point.friction_coefficient,
        pairs_closed: state.pairs_closed(),
        contact_force_n: state.contact_force_n(),
        back_force_n: state.back_force_n,
        force_n: state.force_n.clone(),
        places: known.map_or_else(Vec::new, |(contact, axis)| places(&contact.places, axis, backward)),
    })
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A unit vector; `None` for the zero vector.
fn unit(a: [f64; 3]) -> Option<[f64; 3]> {
    let length = dot(a, a).sqrt();
    (length > 0.0).then(|| a.map(|value| value / length))
}

/// Places of the pairs, with the disc turning right-handed about its axis, or the other way if it turns `backward`.
fn places(pairs: &[PairPlace], axis: &DiscAxis, backward: bool) -> Vec<Place> {
    let Some(turning) = unit(axis.axis_direction) else { return vec![] };
    let from_axis: Vec<[f64; 3]> = pairs
        .iter()
        .map(|pair| {
            let from: [f64; 3] = std::array::from_fn(|k| pair.at_m[k] - axis.axis_point_m[k]);
            let along = dot(from, turning);
            std::array::from_fn(|k| from[k] - along * turning[k])
        })
        .collect();
    let middle: [f64; 3] =
        std::array::from_fn(|k| from_axis.iter().map(|from| from[k]).sum::<f64>() / pairs.len().max(1) as f64);
    // Pairs all around the axis have no middle direction; any will do.
    let radius = from_axis.iter().map(|from| dot(*from, *from).sqrt()).fold(0.0, f64::max);
    let far = dot(middle, middle).sqrt() > 1e-6 * radius;
    let outward = if far { unit(middle) } else { from_axis.first().copied().and_then(unit) };
    let Some(outward) = outward else { return vec![] };
    let moving = cross(turning, outward).map(|value| if backward { -value } else { value });
    let height = dot(middle, outward);
    let first = pairs.first().map_or([0.0; 3], |pair| pair.normal);
    let place = |(pair, from): (&PairPlace, &[f64; 3])| Place {
        along_m: dot(*from, moving),
        outward_m: dot(*from, outward) - height,
        opposite: dot(pair.normal, first) < 0.0,
    };
    pairs.iter().zip(&from_axis).map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four nodes around (0, 0.1, 0) of a disc that turns about +z: at positive speed the disc moves along -x there, so the
    /// pair at +x is at the leading edge, on the left.
    #[test]
    fn the_leading_edge_is_on_the_left_for_either_direction() {
        let axis = DiscAxis { axis_point_m: [0.0, 0.0, 5.0], axis_direction: [0.0, 0.0, 2.0], normal: [0.0, 0.0, 1.0] };
        let pair = |x: f64, y: f64, up: f64| PairPlace { at_m: [x, y, 0.3], normal: [0.0, 0.0, up] };
        let pairs = [pair(0.01, 0.09, 1.0), pair(-0.01, 0.09, 1.0), pair(0.01, 0.11, 1.0), pair(-0.01, 0.11, -1.0)];
        let found = places(&pairs, &axis, false);
        for (place, (along, outward)) in found.iter().zip([(-0.01, -0.01), (0.01, -0.01), (-0.01, 0.01), (0.01, 0.01)])
        {
            assert!((place.along_m - along).abs() < 1e-15 && (place.outward_m - outward).abs() < 1e-15, "{found:?}");
        }
        assert_eq!(found.iter().map(|place| place.opposite).collect::<Vec<_>>(), [false, false, false, true]);
        for (forward, backward) in found.iter().zip(places(&pairs, &axis, true)) {
            assert_eq!((backward.along_m, backward.outward_m), (-forward.along_m, forward.outward_m));
        }
    }

    /// The forces are those of the state that a prediction takes.
    #[test]
    fn the_forces_are_those_of_the_state() {
        let rig = Rig::load("rough-pad").unwrap();
        let point = rig.reference;
        let found = contact(&rig, &point).unwrap();
        let state = rig.model.at(&point).unwrap().state().unwrap().clone();
        assert_eq!((&found.force_n, found.pairs_closed), (&state.force_n, state.pairs_closed()));
        // The rig measures the force on the back of the pad, which nothing but the contact carries.
        assert!((found.back_force_n - point.normal_load_n).abs() < 1e-9 * point.normal_load_n, "{found:?}");
        assert!(found.places.is_empty(), "inline pairs have no place");
        // A figure for each face of the disc, with all pairs between them.
        let at = |opposite| Place { along_m: 0.002, outward_m: 0.001, opposite };
        let both = Contact { places: [false, true, true, false, false, true, false].map(at).into(), ..found.clone() };
        let faces = both.faces();
        assert_eq!(faces.iter().map(Vec::len).collect::<Vec<_>>(), [4, 3]);
        assert_eq!(faces[1][0], Dot { place_mm: Some((2.0, 1.0)), force_n: found.force_n[1] });
        assert_eq!((found.faces().len(), found.faces()[0].len()), (1, 7));
        let open = OperatingPoint { normal_load_n: 0.0, ..point };
        assert_eq!(contact(&rig, &open).unwrap_err(), "contact open: no normal load");
        let closed = Rig::load("nine-dof").unwrap();
        assert!(contact(&closed, &closed.reference).unwrap_err().contains("always closed"));
    }
}
