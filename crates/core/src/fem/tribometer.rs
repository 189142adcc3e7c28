//! The reference rig: a pad-on-disc tribometer like the one of the paper this project implements, used there to test
//! model reduction.
//!
//! ```text
//!            spring holder        fixed along x and z at its top, free along y
//!              : : :              nine springs
//!            cylinder
//!            sensor holder == linear bearing == bracket plate    y fixed, x and z on springs at its back
//!            force sensor
//!            pad holder
//!            pad
//!   ======== disc ========        clamped between two disc holders
//! ```
//!
//! Components, materials, supports and springs are the published ones. The dimensions are this project's own, tuned to
//! the published first frequencies: upper part 331.44 Hz, lower part 1300.6 Hz, assembly at rest 510.91 Hz. They agree
//! within 1 % at the default size, which has one layer of bricks through the disc. Finer meshes are softer, above all
//! the disc, because several layers of bricks allow shear between the clamped faces:
//!
//! * 22 032 degrees of freedom: 333.8, 1305.3 and 510.1 Hz,
//! * 101 908 degrees of freedom: 332.1, 1295.6 and 505.5 Hz,
//! * 220 285 degrees of freedom: 331.1, 1275.6 and 503.4 Hz.
//!
//! The published mesh itself is unknown. It is reported with 904 968 degrees of freedom in 121 864 eight-node bricks,
//! more than such bricks can have.
//!
//! `y` points up, `y = 0` is the upper face of the disc, and the disc turns about the `y` axis. The pad is centred near
//! `x = ` [`MEAN_RADIUS_M`].
//!
//! # Source
//! Table 2, Table 3 and section 4 of the paper this project implements; see `README.md`.

use std::f64::consts::TAU;

use super::mesh::{divided, pieces};
use super::{Axis, Block, Extent, FemError, Material, Mesh, SOLID, Spring, Structure, stations};

/// Distance of the middle of the cylinder from the axis of the disc, m.
pub const MEAN_RADIUS_M: f64 = 0.1;
/// Number of contact pairs along the radius and along the sliding direction.
pub const PATCH: [usize; 2] = [14, 21];
/// Normal stiffness of each contact pair, N/m.
pub const CONTACT_STIFFNESS_N_PER_M: f64 = 1.251e7;

/// Axis about which the disc turns.
pub const AXIS: Axis = Axis { point_m: [0.0; 3], direction: [0.0, 1.0, 0.0] };

const fn material(density_kg_per_m3: f64, young_pa: f64, poisson: f64) -> Material {
    Material { density_kg_per_m3, young_pa, poisson }
}

/// What the rig is made of: the arguments of its finite-element model.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Properties {
    /// Dimensions.
    pub dimensions: Dimensions,
    /// Materials of the components.
    pub materials: Materials,
    /// Springs.
    pub supports: Supports,
}

/// Materials of the components.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Materials {
    /// The friction material.
    pub pad: Material,
    /// Holder of the pad.
    pub pad_holder: Material,
    /// Force sensor.
    pub force_sensor: Material,
    /// Sensor holder.
    pub sensor_holder: Material,
    /// Linear bearing and bracket plate.
    pub linear_bearing: Material,
    /// Cylinder.
    pub cylinder: Material,
    /// Spring holder.
    pub spring_holder: Material,
    /// Disc.
    pub disc: Material,
    /// Both disc holders.
    pub disc_holder: Material,
}

impl Default for Materials {
    fn default() -> Self {
        Self {
            pad: material(4500.0, 20e9, 0.29),
            pad_holder: material(7000.0, 180e9, 0.3),
            force_sensor: material(7700.0, 190e9, 0.28),
            sensor_holder: material(7800.0, 196e9, 0.3),
            linear_bearing: material(7850.0, 210e9, 0.28),
            cylinder: material(7800.0, 196e9, 0.3),
            spring_holder: material(7800.0, 196e9, 0.3),
            disc: material(7800.0, 210e9, 0.27),
            disc_holder: material(7700.0, 200e9, 0.27),
        }
    }
}

/// Springs of the upper part, N/m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Supports {
    /// Total stiffness along x and along z of the ground springs, spread over the supported part of the back of the bracket
    /// plate.
    pub ground_spring_n_per_m: f64,
    /// Stiffness along y of the spring between the middles of spring holder and cylinder.
    pub middle_spring_n_per_m: f64,
    /// Stiffness along x, y and z of each spring between the corners and edge middles of spring holder and cylinder.
    pub edge_spring_n_per_m: [f64; 3],
}

impl Default for Supports {
    fn default() -> Self {
        Self { ground_spring_n_per_m: 1e10, middle_spring_n_per_m: 1e9, edge_spring_n_per_m: [1e10, 1e6, 1e10] }
    }
}

/// Dimensions of the rig, m. In the upper part, `x` is measured from [`MEAN_RADIUS_M`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dimensions {
    /// Where the pad begins and ends along x.
    pub pad_x: [f64; 2],
    /// Half width of the pad along z.
    pub pad_half_z: f64,
    /// Height of the pad.
    pub pad_height: f64,
    /// Half widths along x and z.
    pub pad_holder_half: [f64; 2],
    /// Height of the pad holder.
    pub pad_holder_height: f64,
    /// Half widths along x and z of force sensor and sensor holder; both are grid lines of the pad.
    pub column_half: [f64; 2],
    /// Height of the force sensor.
    pub sensor_height: f64,
    /// Heights of three sections of the sensor holder: `shank_height` below the bearing, `bearing_height` at it and
    /// `collar_height` above it.
    pub shank_height: f64,
    /// Height of the sensor holder beside the bearing.
    pub bearing_height: f64,
    /// Height of the sensor holder above the bearing.
    pub collar_height: f64,
    /// Half width of the linear bearing along x.
    pub bearing_half_x: f64,
    /// Depth of the linear bearing along z.
    pub bearing_depth: f64,
    /// Depth of the bracket plate along z.
    pub plate_depth: f64,
    /// Half widths of the cylinder along x and z.
    pub cylinder_half: [f64; 2],
    /// Height of the cylinder.
    pub cylinder_height: f64,
    /// Half widths of the spring holder along x and z.
    pub spring_holder_half: [f64; 2],
    /// Height of the spring holder.
    pub spring_holder_height: f64,
    /// Outer radius of the disc.
    pub disc_radius: f64,
    /// Thickness of the disc.
    pub disc_thickness: f64,
    /// Radius of the bore of disc and holders.
    pub bore_radius: f64,
    /// Outer radius of the disc holders.
    pub disc_holder_radius: f64,
    /// Height of each disc holder.
    pub disc_holder_height: f64,
    /// Distance from the contact patch to the edge of the finely meshed part of the disc, along the radius and along
    /// the circumference.
    pub margin: [f64; 2],
}

impl Default for Dimensions {
    fn default() -> Self {
        Self {
            pad_x: [-0.012, 0.014],
            pad_half_z: 0.020,
            pad_height: 0.012,
            pad_holder_half: [0.018, 0.024],
            pad_holder_height: 0.034,
            column_half: [0.012, 0.010],
            sensor_height: 0.024,
            shank_height: 0.0997,
            bearing_height: 0.056,
            collar_height: 0.0085,
            bearing_half_x: 0.018,
            bearing_depth: 0.0343,
            plate_depth: 0.0094,
            cylinder_half: [0.024, 0.024],
            cylinder_height: 0.076,
            spring_holder_half: [0.034, 0.034],
            spring_holder_height: 0.015,
            disc_radius: 0.140,
            disc_thickness: 0.013_48,
            bore_radius: 0.020,
            disc_holder_radius: 0.050,
            disc_holder_height: 0.030,
            margin: [0.011, 0.010],
        }
    }
}

/// One of the two substructures, with free contact interface.
#[derive(Clone, Debug)]
pub struct Part {
    /// Mesh, supports and springs.
    pub structure: Structure,
    /// Nodes of the contact patch; the position along x varies fastest.
    pub interface: Vec<usize>,
}

/// The rig: the upper part above the contact, and the disc with its holders. `pad.interface[k]` and `disc.interface[k]`
/// coincide.
#[derive(Clone, Debug)]
pub struct Tribometer {
    /// The upper part: pad, holders, sensor, bearing, cylinder.
    pub pad: Part,
    /// The lower part: disc and holders.
    pub disc: Part,
    /// Nodes of the upper part on which the normal load presses down: the top of the spring holder.
    pub loaded: Vec<usize>,
    /// Area of the pad's face, m².
    pub contact_area_m2: f64,
}

impl Tribometer {
    /// The rig meshed with bricks of about `spacing_m`, m, away from the contact patch. The upper part is meshed more
    /// finely, because its column is thinner than the disc is wide.
    pub fn with_spacing(properties: &Properties, spacing_m: f64) -> Self {
        let Properties { dimensions, materials, .. } = properties;
        let (pad, loaded) = upper_part(properties, 0.6 * spacing_m);
        let [from, to] = dimensions.pad_x;
        let contact_area_m2 = (to - from) * 2.0 * dimensions.pad_half_z;
        Self { pad, disc: lower_part(dimensions, materials, spacing_m), loaded, contact_area_m2 }
    }

    /// The coarsest mesh found with at least `dof` degrees of freedom in both parts together.
    ///
    /// # Errors
    /// [`FemError::Size`] if `dof` is below the size of the coarsest mesh, rounded down to thousands.
    pub fn with_dof(properties: &Properties, dof: usize) -> Result<Self, FemError> {
        let (mut coarse, mut fine) = (0.1, 0.1);
        let mut found = Self::with_spacing(properties, fine);
        let least = found.dof() / 1000 * 1000;
        if dof < least {
            return Err(FemError::Size { value: dof, limit: least });
        }
        while found.dof() < dof {
            (coarse, fine) = (fine, 0.85 * fine);
            found = Self::with_spacing(properties, fine);
        }
        while coarse / fine > 1.002 {
            let spacing_m = (coarse * fine).sqrt();
            let between = Self::with_spacing(properties, spacing_m);
            if between.dof() < dof {
                coarse = spacing_m;
            } else {
                (fine, found) = (spacing_m, between);
            }
        }
        Ok(found)
    }

    /// The assembly at rest: both parts joined by one spring per contact pair along the contact normal,
    /// `contact_stiffness_n_per_m` each.
    pub fn at_rest(&self, contact_stiffness_n_per_m: f64) -> Structure {
        let mut whole = self.pad.structure.clone();
        let first = whole.append(&self.disc.structure);
        whole.springs.extend(self.pad.interface.iter().zip(&self.disc.interface).map(|(&node, &other)| Spring {
            node,
            other: Some(first + other),
            direction: 1,
            stiffness_n_per_m: contact_stiffness_n_per_m,
        }));
        whole
    }

    /// Number of free degrees of freedom of both parts.
    pub fn dof(&self) -> usize {
        self.pad.structure.dof() + self.disc.structure.dof()
    }
}

/// Grid lines of the contact patch: along x, measured from [`MEAN_RADIUS_M`], and along z.
fn patch_lines(dimensions: &Dimensions) -> [Vec<f64>; 2] {
    let lines = |from: f64, to: f64, nodes: usize| [from].into_iter().chain(divided(from, to, nodes - 1)).collect();
    let ([inner, outer], half_z) = (dimensions.pad_x, dimensions.pad_half_z);
    [lines(inner, outer, PATCH[0]), lines(-half_z, half_z, PATCH[1])]
}

/// A subset of grid lines about `spacing` apart, both ends included; `lines` are a refinement of it.
fn thinned(lines: &[f64], spacing: f64) -> Vec<f64> {
    let last = lines.len() - 1;
    let count = pieces(lines[last] - lines[0], spacing).min(last);
    (0..=count).map(|piece| lines[(piece * last + count / 2) / count]).collect()
}

/// Grid lines of the upper part along x or z: through 0, the ends of the pad and the `edges` of components. Within the
/// pad they are a subset of its lines, so that the mesh of the pad refines them.
fn lines_above(edges: &[f64], pad_lines: &[f64], spacing: f64) -> Vec<f64> {
    let [first, last] = ends(pad_lines);
    let mut edges: Vec<f64> = edges.iter().copied().chain([first, 0.0, last]).collect();
    edges.sort_by(f64::total_cmp);
    edges.dedup_by(|a, b| same(*a, *b));
    let mut lines = vec![edges[0]];
    for pair in edges.windows(2) {
        let (from, to) = (pair[0], pair[1]);
        let within = between(pad_lines, from, to);
        if from > first - NEAR && to < last + NEAR {
            lines.extend_from_slice(&thinned(&within, spacing)[1..]);
        } else {
            lines.extend(divided(from, to, pieces(to - from, spacing)));
        }
    }
    lines
}

/// Distance below which two lengths are equal, m.
const NEAR: f64 = 1e-9;

fn same(a: f64, b: f64) -> bool {
    (a - b).abs() < NEAR
}

/// The grid lines from one value to another, both included.
fn between(lines: &[f64], from: f64, to: f64) -> Vec<f64> {
    lines.iter().copied().filter(|&line| line > from - NEAR && line < to + NEAR).collect()
}

/// The upper part, above the contact, and the nodes at its top.
fn upper_part(properties: &Properties, spacing: f64) -> (Part, Vec<usize>) {
    let Properties { dimensions: d, materials, supports } = properties;
    let [pad_x, pad_z] = patch_lines(d);
    let (bearing_z, plate_z) = (d.column_half[1] + d.bearing_depth, d.column_half[1] + d.bearing_depth + d.plate_depth);
    let halves = [d.pad_holder_half, d.column_half, d.cylinder_half, d.spring_holder_half];
    let edges = |axis: usize| halves.iter().flat_map(move |half| [-half[axis], half[axis]]);
    let edges_x: Vec<f64> = edges(0).chain([-d.bearing_half_x, d.bearing_half_x]).collect();
    let edges_z: Vec<f64> = edges(1).chain([bearing_z, plate_z]).collect();
    let (x, z) = (lines_above(&edges_x, &pad_x, spacing), lines_above(&edges_z, &pad_z, spacing));
    let heights = [
        d.pad_height,
        d.pad_holder_height,
        d.sensor_height,
        d.shank_height,
        d.bearing_height,
        d.collar_height,
        d.cylinder_height,
        d.spring_holder_height,
    ];
    let mut levels = vec![0.0];
    for height in heights {
        levels.push(levels[levels.len() - 1] + height);
    }
    let y = stations(&levels, spacing);

    let mut mesh = Mesh::default();
    // Adds a box with a half width along x, between two levels and two depths, joined to the blocks `on`.
    let mut add =
        |name: &str, material, half_x: f64, [low, high]: [usize; 2], [front, back]: [f64; 2], on: &[&Block]| {
            let component = mesh.add_component(name, material);
            let lines = match name {
                "pad" => [pad_x.clone(), between(&y, levels[low], levels[high]), pad_z.clone()],
                _ => [between(&x, -half_x, half_x), between(&y, levels[low], levels[high]), between(&z, front, back)],
            };
            mesh.add_block(component, lines, SOLID, on, |[x, y, z]| [MEAN_RADIUS_M + x, y, z])
        };
    let around = |half: [f64; 2]| [-half[1], half[1]];
    let [column_x, column_z] = d.column_half;
    let pad_holder =
        add("pad-holder", materials.pad_holder, d.pad_holder_half[0], [1, 2], around(d.pad_holder_half), &[]);
    let pad = add("pad", materials.pad, d.pad_x[1], [0, 1], [-d.pad_half_z, d.pad_half_z], &[&pad_holder]);
    let sensor = add("force-sensor", materials.force_sensor, column_x, [2, 3], around(d.column_half), &[&pad_holder]);
    let sensor_holder =
        add("sensor-holder", materials.sensor_holder, column_x, [3, 6], around(d.column_half), &[&sensor]);
    let bearing = add(
        "linear-bearing",
        materials.linear_bearing,
        d.bearing_half_x,
        [4, 5],
        [column_z, bearing_z],
        &[&sensor_holder],
    );
    let plate = add(
        "bracket-plate",
        materials.linear_bearing,
        d.spring_holder_half[0],
        [4, 7],
        [bearing_z, plate_z],
        &[&bearing],
    );
    let cylinder =
        add("cylinder", materials.cylinder, d.cylinder_half[0], [6, 7], around(d.cylinder_half), &[&sensor_holder]);
    let spring_holder = add(
        "spring-holder",
        materials.spring_holder,
        d.spring_holder_half[0],
        [7, 8],
        around(d.spring_holder_half),
        &[],
    );

    let interface = level(&pad, 0).collect();
    let mut structure = Structure { mesh, ..Structure::default() };
    let top: Vec<usize> = level(&spring_holder, spring_holder.counts()[1] - 1).collect();
    structure.fixed.extend(top.iter().flat_map(|&node| [(node, 0), (node, 2)]));
    hold_plate(&mut structure, &plate, [levels[4], levels[5]], d.bearing_half_x, supports);
    join_cylinder(&mut structure, [&cylinder, &spring_holder], levels[7], d.cylinder_half, supports);
    (Part { structure, interface }, top)
}

/// Adds the springs between the top of the cylinder and the spring holder above it: at the middle, the corners and the
/// edge middles.
fn join_cylinder(
    structure: &mut Structure,
    [cylinder, holder]: [&Block; 2],
    height: f64,
    half: [f64; 2],
    supports: &Supports,
) {
    let at = |block: &Block, x: f64, z: f64| {
        let weights = block.locate([x, height, z]).expect("a place on both faces");
        assert_eq!(weights.len(), 1, "springs join nodes");
        weights[0].0
    };
    for x in [-half[0], 0.0, half[0]] {
        for z in [-half[1], 0.0, half[1]] {
            let (node, other) = (at(cylinder, x, z), Some(at(holder, x, z)));
            let middle = x == 0.0 && z == 0.0;
            let stiffness =
                if middle { [0.0, supports.middle_spring_n_per_m, 0.0] } else { supports.edge_spring_n_per_m };
            let along = stiffness.into_iter().enumerate().filter(|(_, stiffness)| *stiffness > 0.0);
            structure.springs.extend(along.map(|(direction, stiffness_n_per_m)| Spring {
                node,
                other,
                direction,
                stiffness_n_per_m,
            }));
        }
    }
}

/// Supports the back of the bracket plate over the bearing: `y` fixed, `x` and `z` on springs distributed over the
/// area.
fn hold_plate(structure: &mut Structure, plate: &Block, [low, high]: [f64; 2], half_x: f64, supports: &Supports) {
    let back = plate.counts()[2] - 1;
    // Length of the supported part that belongs to each grid line.
    let shares = |lines: &[f64], low: f64, high: f64| -> Vec<f64> {
        let clipped = |line: f64| line.clamp(low, high);
        (0..lines.len())
            .map(|k| {
                let before = clipped(lines[k.saturating_sub(1)]);
                let after = clipped(lines[(k + 1).min(lines.len() - 1)]);
                0.5 * (after - before)
            })
            .collect()
    };
    let (x, y) = (shares(plate.lines(0), -half_x, half_x), shares(plate.lines(1), low, high));
    let area = 2.0 * half_x * (high - low);
    for (j, height) in y.iter().enumerate() {
        for (i, width) in x.iter().enumerate() {
            if width * height > NEAR * NEAR {
                let node = plate.node([i, j, back]);
                structure.fixed.insert((node, 1));
                let stiffness_n_per_m = supports.ground_spring_n_per_m * width * height / area;
                structure.springs.extend([0, 2].map(|direction| Spring {
                    node,
                    other: None,
                    direction,
                    stiffness_n_per_m,
                }));
            }
        }
    }
}

/// The lower part: the disc between its holders.
fn lower_part(d: &Dimensions, materials: &Materials, spacing: f64) -> Part {
    let [patch_x, patch_z] = patch_lines(d);
    // Fine mesh around the contact patch: grid lines of radius and angle, with margins around the patch.
    let with_margins = |patch: &[f64], margin: f64, scale: f64| {
        let (first, last) = (patch[0], patch[patch.len() - 1]);
        let cells = pieces(margin, spacing).min(5);
        let mut lines = vec![first - margin];
        lines.extend(divided(first - margin, first, cells));
        lines.extend_from_slice(&patch[1..]);
        lines.extend(divided(last, last + margin, cells));
        lines.iter().map(|line| line * scale).collect::<Vec<f64>>()
    };
    let fine_r: Vec<f64> = with_margins(&patch_x, d.margin[0], 1.0).iter().map(|line| MEAN_RADIUS_M + line).collect();
    let fine_angle = with_margins(&patch_z, d.margin[1], 1.0 / MEAN_RADIUS_M);
    let ([inner, outer], [start, end]) = (ends(&fine_r), ends(&fine_angle));

    let mut r = stations(&[d.bore_radius, d.disc_holder_radius, inner], spacing);
    r.extend_from_slice(&thinned(&fine_r, spacing)[1..]);
    r.extend_from_slice(&stations(&[outer, d.disc_radius], spacing)[1..]);
    let mut angle = thinned(&fine_angle, spacing / MEAN_RADIUS_M);
    let rest = TAU - (end - start);
    angle.extend(divided(end, start + TAU, pieces(rest * MEAN_RADIUS_M, spacing).max(16)));
    let y = stations(&[-d.disc_thickness, 0.0], spacing.min(d.disc_thickness));
    let top = y.len() - 1;

    let mut mesh = Mesh::default();
    let polar = |[r, y, angle]: [f64; 3]| [r * angle.cos(), y, r * angle.sin()];
    let disc = mesh.add_component("disc", materials.disc);
    let hole = |[i, _, k]: [usize; 3]| {
        let (r, angle) = (0.5 * (r[i] + r[i + 1]), 0.5 * (angle[k] + angle[k + 1]));
        r > inner && r < outer && angle > start && angle < end
    };
    let around = Extent { filled: &|cell| !hole(cell), closed: true };
    let ring = mesh.add_block(disc, [r.clone(), y.clone(), angle.clone()], around, &[], polar);
    // Rectangular within the patch, polar at the outer edge, blended across the margins.
    let blended = |at: [f64; 3]| {
        let (x, z) = (at[0] - MEAN_RADIUS_M, at[2] * MEAN_RADIUS_M);
        let beyond = |value: f64, lines: &[f64], margin: f64| {
            let [first, last] = ends(lines);
            ((first - value).max(value - last) / margin).max(0.0)
        };
        let share = beyond(x, &patch_x, d.margin[0]).max(beyond(z, &patch_z, d.margin[1]));
        let (round, straight) = (polar(at), [at[0], at[1], z]);
        [0, 1, 2].map(|axis| share * round[axis] + (1.0 - share) * straight[axis])
    };
    let fine = mesh.add_block(disc, [fine_r.clone(), y, fine_angle.clone()], SOLID, &[&ring], blended);

    let holder = mesh.add_component("disc-holder", materials.disc_holder);
    let clamped: Vec<f64> = r.iter().copied().filter(|&line| line < d.disc_holder_radius + 1e-9).collect();
    for (from, to) in [(0.0, d.disc_holder_height), (-d.disc_thickness - d.disc_holder_height, -d.disc_thickness)] {
        let lines = [clamped.clone(), stations(&[from, to], spacing), angle.clone()];
        mesh.add_block(holder, lines, Extent { filled: &|_| true, closed: true }, &[&ring], polar);
    }

    let mut structure = Structure { mesh, ..Structure::default() };
    for level in [0, top] {
        for i in 0..clamped.len() {
            for k in 0..angle.len() - 1 {
                let node = ring.node([i, level, k]);
                structure.fixed.extend([0, 1, 2].map(|direction| (node, direction)));
            }
        }
    }
    let cells = (fine.counts()[0] - PATCH[0]) / 2;
    let cells_z = (fine.counts()[2] - PATCH[1]) / 2;
    let interface = (0..PATCH[1])
        .flat_map(|k| (0..PATCH[0]).map(move |i| [cells + i, top, cells_z + k]))
        .map(|point| fine.node(point))
        .collect();
    Part { structure, interface }
}

/// Nodes of a block on its `j`-th level; the position along x varies fastest.
fn level(block: &Block, j: usize) -> impl Iterator<Item = usize> {
    let [x, _, z] = block.counts();
    (0..z).flat_map(move |k| (0..x).map(move |i| block.node([i, j, k])))
}

fn ends(lines: &[f64]) -> [f64; 2] {
    [lines[0], lines[lines.len() - 1]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reduction::lowest_modes;

    /// The `count` lowest natural frequencies, Hz, by [`lowest_modes`].
    fn frequencies_hz(structure: &Structure, count: usize) -> Vec<f64> {
        let assembled = structure.assemble().unwrap();
        let modes = lowest_modes("structure", &assembled.mass, &assembled.stiffness, count).unwrap();
        modes.omega_squared.iter().map(|square| square.sqrt() / TAU).collect()
    }

    #[test]
    fn the_first_frequencies_of_the_default_size_are_the_published_ones() {
        // Table 3 of the paper, within the 1 % that the dimensions were tuned for.
        let tribometer = Tribometer::with_dof(&Properties::default(), 20_000).unwrap();
        let whole = tribometer.at_rest(CONTACT_STIFFNESS_N_PER_M);
        for (what, structure, published_hz) in [
            ("upper part", &tribometer.pad.structure, 331.44),
            ("lower part", &tribometer.disc.structure, 1300.6),
            ("whole at rest", &whole, 510.91),
        ] {
            let found = frequencies_hz(structure, 3);
            eprintln!("{what}: {found:.2?} Hz, published {published_hz}");
            assert!((found[0] / published_hz - 1.0).abs() < 0.01, "{what}: {} Hz, not {published_hz}", found[0]);
        }
    }

    #[test]
    fn the_same_294_pairs_coincide_at_any_size() {
        let properties = Properties::default();
        let mut places: Option<Vec<[f64; 3]>> = None;
        for dof in [5_000, 20_000, 100_000] {
            let tribometer = Tribometer::with_dof(&properties, dof).unwrap();
            assert!((dof..dof + dof / 4).contains(&tribometer.dof()), "{} for {dof}", tribometer.dof());
            let at = |part: &Part| -> Vec<[f64; 3]> {
                let mesh = &part.structure.mesh;
                assert!(part.interface.iter().all(|node| !mesh.hanging.contains_key(node)));
                part.interface.iter().map(|&node| mesh.nodes_m[node]).collect()
            };
            let (pad, disc) = (at(&tribometer.pad), at(&tribometer.disc));
            assert_eq!(pad.len(), 294);
            for (a, b) in pad.iter().zip(&disc) {
                assert!((0..3).all(|axis| (a[axis] - b[axis]).abs() < 1e-12), "{a:?} {b:?}");
            }
            let first = places.get_or_insert_with(|| pad.clone());
            assert!(pad.iter().flatten().zip(first.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-12));
        }
    }

    #[test]
    fn the_mass_is_that_of_boxes_and_rings() {
        // Density times volume of each component, calculated by hand. The polar mesh approximates rings by polygons.
        let d = Dimensions::default();
        let tribometer = Tribometer::with_dof(&Properties::default(), 20_000).unwrap();
        let mass_kg = |part: &Part, name: &str| -> f64 {
            let mesh = &part.structure.mesh;
            let of_it = |brick: &&super::super::Brick| mesh.components[brick.component].name == name;
            mesh.bricks
                .iter()
                .filter(of_it)
                .map(|brick| {
                    let material = &mesh.components[brick.component].material;
                    let matrices = super::super::brick(&mesh.corners_m(brick), material).unwrap();
                    // Mean over translations along x, y and z.
                    (0..24)
                        .flat_map(|i| (i % 3..24).step_by(3).map(move |j| (i, j)))
                        .map(|(i, j)| matrices.mass[i][j])
                        .sum::<f64>()
                        / 3.0
                })
                .sum()
        };
        let box_of = |[x, z]: [f64; 2], height: f64| 4.0 * x * z * height;
        let column_height = d.shank_height + d.bearing_height + d.collar_height;
        for (name, expected) in [
            ("pad", 4500.0 * 0.026 * 0.040 * d.pad_height),
            ("pad-holder", 7000.0 * box_of(d.pad_holder_half, d.pad_holder_height)),
            ("force-sensor", 7700.0 * box_of(d.column_half, d.sensor_height)),
            ("sensor-holder", 7800.0 * box_of(d.column_half, column_height)),
            ("cylinder", 7800.0 * box_of(d.cylinder_half, d.cylinder_height)),
            ("spring-holder", 7800.0 * box_of(d.spring_holder_half, d.spring_holder_height)),
        ] {
            let found = mass_kg(&tribometer.pad, name);
            assert!((found / expected - 1.0).abs() < 1e-10, "{name}: {found} kg, not {expected}");
        }
        let ring = |outer: f64, height: f64| TAU / 2.0 * (outer.powi(2) - d.bore_radius.powi(2)) * height;
        let disc = mass_kg(&tribometer.disc, "disc") / (7800.0 * ring(d.disc_radius, d.disc_thickness));
        let holders = mass_kg(&tribometer.disc, "disc-holder")
            / (2.0 * 7700.0 * ring(d.disc_holder_radius, d.disc_holder_height));
        assert!(disc < 1.0 && disc > 0.98 && holders < 1.0 && holders > 0.98, "{disc} {holders}");
    }

    #[test]
    fn a_size_below_the_coarsest_mesh_is_refused() {
        let refused = Tribometer::with_dof(&Properties::default(), 1_000).unwrap_err();
        assert!(matches!(refused, FemError::Size { value: 1_000, limit: 1_001..=5_000 }), "{refused}");
    }
}
