//! Contact patches of modal substructures: contact pairs and the triad `n, t, b` of each.
//!
//! Every selected pad node is a contact point. With the disc's axis through `a` along the unit vector `e`, and `n` the
//! given normal from disc to pad,
//!
//! ```text
//! r = x - a,   t = (e × r) / |e × r|,   b = n × t,   radius = |e × r|
//! ```
//!
//! so that at positive speed the disc moves along `+t`. If a disc node coincides with the pad node (within a millionth
//! of the size of the patch), the two form the pair. Otherwise the disc's displacement is interpolated between its
//! nodes, projected along the normal (`interpolation`).

use super::RigError;
use super::interpolation::{Interpolation, Plane};
use super::raw::RawPatch;
use super::settings::{MOST_TERMS, at_most, spread, within};

/// Nodes coincide if their distance is at most this times the size of the patch.
const COINCIDENT: f64 = 1e-6;

/// Smallest `|n·e|`: the normal `n` may be at most 60 degrees off the axis `e`. Beyond that the pad would press on the
/// rim of the disc.
const LEAST_COSINE: f64 = 0.5;

/// One contact pair.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    pub pad_node: usize,
    /// Disc nodes and their weights, a row of `T`; weights sum to 1. Empty for a rigid disc.
    pub disc: Vec<(usize, f64)>,
    /// `n`, `t`, `b`.
    pub normal: [f64; 3],
    pub sliding: [f64; 3],
    pub lateral: [f64; 3],
    /// Distance from the axis, m.
    pub radius_m: f64,
}

pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

fn scaled(a: [f64; 3], factor: f64) -> [f64; 3] {
    a.map(|value| value * factor)
}

/// The contact pairs of all patches, in the order of the patches.
pub struct Contacts {
    pub pairs: Vec<Pair>,
    /// Contact stiffness of each pair.
    pub stiffness_n_per_m: Vec<f64>,
    /// Contact damping of each pair.
    pub damping_n_s_per_m: Vec<f64>,
}

/// The contact pairs of all patches, with stiffness and damping; `disc_m` is `None` for a rigid disc.
///
/// # Errors
/// Those of [`pairs`]; [`RigError::Range`] for negative stiffness or damping; [`RigError::Shape`] if there are neither
/// one value nor as many as pairs.
pub fn contacts(
    file: &str,
    patches: &[RawPatch],
    pad_m: &[[f64; 3]],
    disc_m: Option<&[[f64; 3]]>,
) -> Result<Contacts, RigError> {
    let mut contacts = Contacts { pairs: vec![], stiffness_n_per_m: vec![], damping_n_s_per_m: vec![] };
    at_most(file, "contact_patch", patches.len(), MOST_TERMS)?;
    for (index, raw) in patches.iter().enumerate() {
        let found = pairs(file, index, raw, pad_m, disc_m)?;
        for (key, values, all) in [
            ("stiffness_n_per_m", &raw.stiffness_n_per_m, &mut contacts.stiffness_n_per_m),
            ("damping_n_s_per_m", &raw.damping_n_s_per_m, &mut contacts.damping_n_s_per_m),
        ] {
            let field = format!("contact_patch[{index}].{key}");
            for value in spread(file, &field, values, found.len(), "contact pairs")? {
                all.push(within(file, &field, value, value >= 0.0, "at least 0")?);
            }
        }
        contacts.pairs.extend(found);
    }
    Ok(contacts)
}

/// The contact pairs of the `index`-th patch, one for each selected pad node; `disc_m` is `None` for a rigid disc.
///
/// # Errors
/// [`RigError::NotFinite`], [`RigError::Range`], [`RigError::NoPartner`], [`RigError::NoTriad`].
fn pairs(
    file: &str,
    index: usize,
    raw: &RawPatch,
    pad_m: &[[f64; 3]],
    disc_m: Option<&[[f64; 3]]>,
) -> Result<Vec<Pair>, RigError> {
    let field = |key: &str| format!("contact_patch[{index}].{key}");
    for (axis, &value) in raw.axis_point_m.iter().enumerate() {
        super::settings::finite(file, &format!("{}[{axis}]", field("axis_point_m")), value)?;
    }
    let axis = unit(file, &field("axis_direction"), raw.axis_direction)?;
    let normal = unit(file, &field("normal"), raw.normal)?;
    if dot(normal, axis).abs() < LEAST_COSINE {
        return Err(RigError::Range {
            file: file.to_owned(),
            field: field("normal"),
            value: format!("{:?}, {:.0} degrees off the axis", raw.normal, dot(normal, axis).abs().acos().to_degrees()),
            limit: "at most 60 degrees: the pad presses along the axis of the disc".to_owned(),
        });
    }
    let pad_nodes = selection(file, &field("pad_nodes"), raw.pad_nodes.as_deref(), pad_m.len())?;
    let search_m = raw
        .search_distance_m
        .map(|value| within(file, &field("search_distance_m"), value, value >= 0.0, "at least 0"))
        .transpose()?;
    let surface = match disc_m {
        Some(disc_m) => {
            let nodes = selection(file, &field("disc_nodes"), raw.disc_nodes.as_deref(), disc_m.len())?;
            let positions: Vec<[f64; 3]> = nodes.iter().map(|&node| disc_m[node]).collect();
            let extent = extent(pad_nodes.iter().map(|&node| pad_m[node]).chain(positions.iter().copied()));
            Some((
                nodes,
                Interpolation::new(&positions, Plane::across(normal), search_m),
                positions,
                COINCIDENT * extent,
            ))
        }
        None if raw.disc_nodes.is_some() => {
            let (value, limit) = ("is given for a rigid disc".to_owned(), "[disc], or no nodes of it".to_owned());
            return Err(RigError::Kind { file: file.to_owned(), field: field("disc_nodes"), value, limit });
        }
        None => None,
    };
    let mut pairs = vec![];
    for pad_node in pad_nodes {
        let position_m = pad_m[pad_node];
        let moving = cross(axis, minus(position_m, raw.axis_point_m));
        let radius_m = norm(moving);
        let no_triad = |value: String, limit: &str| {
            let (file, field, limit) = (file.to_owned(), format!("contact_patch[{index}]"), limit.to_owned());
            Err(RigError::NoTriad { file, field, node: pad_node, position_m: Box::new(position_m), value, limit })
        };
        if radius_m <= 1e-9 * norm(minus(position_m, raw.axis_point_m)).max(f64::MIN_POSITIVE) {
            return no_triad("it lies on the axis".to_owned(), "a node off the axis");
        }
        let sliding = scaled(moving, 1.0 / radius_m);
        let lateral = cross(normal, sliding);
        if norm(lateral) < 1e-6 {
            return no_triad("the normal points along it".to_owned(), "a normal across the sliding direction");
        }
        let disc = match &surface {
            None => vec![],
            Some((nodes, interpolation, positions, coincident)) => {
                let nearest = nearest(positions, position_m);
                match nearest {
                    Some((local, distance)) if distance <= *coincident => vec![(nodes[local], 1.0)],
                    _ => interpolation
                        .weights(position_m)
                        .map_err(|(value, limit)| RigError::NoPartner {
                            file: file.to_owned(),
                            field: format!("contact_patch[{index}]"),
                            node: pad_node,
                            position_m: Box::new(position_m),
                            value,
                            limit,
                        })?
                        .into_iter()
                        .map(|(local, weight)| (nodes[local], weight))
                        .collect(),
                }
            }
        };
        pairs.push(Pair { pad_node, disc, normal, sliding, lateral, radius_m });
    }
    Ok(pairs)
}

/// A direction scaled to unit length.
fn unit(file: &str, field: &str, direction: [f64; 3]) -> Result<[f64; 3], RigError> {
    for (axis, &value) in direction.iter().enumerate() {
        super::settings::finite(file, &format!("{field}[{axis}]"), value)?;
    }
    let largest = direction.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    if largest == 0.0 {
        let (value, limit) = ("[0, 0, 0]".to_owned(), "a direction".to_owned());
        return Err(RigError::Range { file: file.to_owned(), field: field.to_owned(), value, limit });
    }
    let direction = direction.map(|value| value / largest);
    Ok(scaled(direction, 1.0 / norm(direction)))
}

/// The listed node indices, by default all.
fn selection(file: &str, field: &str, listed: Option<&[usize]>, count: usize) -> Result<Vec<usize>, RigError> {
    let Some(listed) = listed else { return Ok((0..count).collect()) };
    let refuse = |field: String, value: String, limit: String| {
        Err(RigError::Range { file: file.to_owned(), field, value, limit })
    };
    if listed.is_empty() {
        return refuse(field.to_owned(), "empty".to_owned(), "at least one node".to_owned());
    }
    let mut seen = vec![false; count];
    for (index, &node) in listed.iter().enumerate() {
        match seen.get_mut(node) {
            None => return refuse(format!("{field}[{index}]"), node.to_string(), format!("0 to {}", count - 1)),
            Some(seen) if *seen => {
                return refuse(
                    format!("{field}[{index}]"),
                    format!("{node} again"),
                    "every node at most once".to_owned(),
                );
            }
            Some(seen) => *seen = true,
        }
    }
    Ok(listed.to_vec())
}

/// Length of the diagonal of the bounding box of some points.
fn extent(points: impl Iterator<Item = [f64; 3]>) -> f64 {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for point in points {
        for axis in 0..3 {
            low[axis] = low[axis].min(point[axis]);
            high[axis] = high[axis].max(point[axis]);
        }
    }
    norm(minus(high, low))
}

/// Index and distance of the point nearest to `to`.
fn nearest(points: &[[f64; 3]], to: [f64; 3]) -> Option<(usize, f64)> {
    points.iter().enumerate().map(|(index, &point)| (index, norm(minus(point, to)))).min_by(|a, b| a.1.total_cmp(&b.1))
}
