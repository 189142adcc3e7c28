//! Uncoupled coordinates: modes with a zero contact row and modal damping only.
//!
//! Their rows and columns of `K` and `C` have only diagonal entries, in every term. Their roots therefore follow from
//! `λ² + c λ + k = 0` and their shapes are unit vectors, exactly and at every operating point. The eigenvalue problem
//! contains only the coupled coordinates.

use faer::{Mat, c64};

use super::law::{Law, Parameter};
use super::model::{KnownTerm, Model, Term};
use super::model_error::ModelError;
use super::operating_point::OperatingPoint;
use super::solver::ROUNDING;
use super::spectrum::{Root, RootError, SolveError, Spectrum, Vectors, order, square_root};

/// A model divided into coupled and uncoupled coordinates.
#[derive(Clone, Debug)]
pub(super) struct Division {
    /// The model of the coupled coordinates.
    pub(super) coupled: Model,
    /// Indices of the coupled coordinates in the whole model.
    places: Vec<usize>,
    /// Indices of the uncoupled coordinates.
    alone: Vec<usize>,
}

impl Model {
    /// Number of uncoupled coordinates: modes that the eigenvalue problem does not contain.
    pub fn decoupled_count(&self) -> usize {
        self.division.as_ref().map_or(0, |division| division.alone.len())
    }

    /// Diagonal entries `k` of `K` and `C`, or of their derivatives, with the `coefficient` of each term.
    fn diagonal(
        &self,
        k: usize,
        p: &OperatingPoint,
        coefficient: impl Fn(&Law) -> f64,
    ) -> Result<[f64; 2], ModelError> {
        let sum = |terms: &[KnownTerm]| {
            terms
                .iter()
                .try_fold(0.0, |sum, known| Ok(sum + known.factor(&coefficient, p)? * known.term.matrix[(k, k)]))
        };
        Ok([sum(&self.stiffness)?, sum(&self.damping)?])
    }
}

/// The source of the vectors of a root.
enum Column {
    Coupled(usize),
    /// Index of an uncoupled coordinate, whose unit vector is the shape, and the scale of the left vector.
    Alone(usize, c64),
}

/// A root before sorting.
struct Entry {
    root: Root,
    column: Column,
    sensitivity: c64,
}

impl Division {
    /// Divides a model; `None` if no coordinate is uncoupled, or all are.
    pub(super) fn of(model: &Model) -> Option<Self> {
        let terms = || model.stiffness.iter().chain(&model.damping);
        let is_alone = |k: usize| {
            let zero = |matrix: &Mat<f64>| {
                (0..model.dimension).all(|i| i == k || matrix[(i, k)] == 0.0 && matrix[(k, i)] == 0.0)
            };
            terms().all(|known| zero(&known.term.matrix))
                && model.steady.as_ref().is_none_or(|contact| contact.is_free_of(k))
        };
        let (alone, places): (Vec<_>, Vec<_>) = (0..model.dimension).partition(|&k| is_alone(k));
        if alone.is_empty() || places.is_empty() {
            return None;
        }
        let part = |m: &Mat<f64>| Mat::from_fn(places.len(), places.len(), |i, j| m[(places[i], places[j])]);
        let part_of = |known: &KnownTerm| KnownTerm {
            term: Term { matrix: part(&known.term.matrix), law: known.term.law.clone() },
            symmetric: known.symmetric,
        };
        let coupled = Model {
            dimension: places.len(),
            stiffness: model.stiffness.iter().map(part_of).collect(),
            damping: model.damping.iter().map(part_of).collect(),
            pad_modes: model.pad_modes.map(|count| places.partition_point(|&k| k < count)),
            pad_mass: model.pad_mass.as_ref().map(part),
            contact_law: model.contact_law,
            has_contact: model.has_contact,
            steady: model.steady.as_ref().map(|contact| Box::new(contact.part(&places))),
            division: None,
        };
        Some(Self { coupled: coupled.finished(), places, alone })
    }

    /// Completes the spectrum of the coupled coordinates with the roots of the uncoupled ones.
    pub(super) fn complete(&self, model: &Model, spectrum: Spectrum, vectors: Vectors) -> Result<Spectrum, SolveError> {
        let of_coupled = |(j, root): (usize, &Root)| {
            let sensitivity = spectrum.friction_sensitivity.get(j).copied().unwrap_or_default();
            Entry { root: *root, column: Column::Coupled(j), sensitivity }
        };
        let mut entries: Vec<Entry> = spectrum.roots.iter().enumerate().map(of_coupled).collect();
        for &k in &self.alone {
            alone(model, k, &spectrum, vectors, &mut entries)?;
        }
        entries.sort_by(|a, b| order(&a.root, &b.root));
        let n = model.dimension();
        let widened = |narrow: &Mat<c64>, alone: fn(c64) -> c64, wanted: bool| {
            let mut wide = Mat::zeros(n, if wanted { entries.len() } else { 0 });
            for (column, entry) in entries.iter().enumerate().take(wide.ncols()) {
                match entry.column {
                    Column::Coupled(j) => {
                        self.places.iter().enumerate().for_each(|(i, &place)| wide[(place, column)] = narrow[(i, j)]);
                    }
                    Column::Alone(k, left) => wide[(k, column)] = alone(left),
                }
            }
            wide
        };
        let with_left = vectors == Vectors::Both;
        Ok(Spectrum {
            mode_count: entries.iter().filter(|entry| entry.root.oscillates()).count(),
            shapes: widened(&spectrum.shapes, |_| c64::ONE, vectors != Vectors::None),
            left: widened(&spectrum.left, |left| left, with_left),
            friction_sensitivity: entries.iter().filter(|_| with_left).map(|entry| entry.sensitivity).collect(),
            roots: entries.into_iter().map(|entry| entry.root).collect(),
            ..spectrum
        })
    }
}

/// Appends the roots of uncoupled coordinate `k` to `out`.
fn alone(model: &Model, k: usize, of: &Spectrum, vectors: Vectors, out: &mut Vec<Entry>) -> Result<(), SolveError> {
    let p = &of.point;
    let [stiffness, damping] = model.diagonal(k, p, |law| model.coefficient(law, p))?;
    let [stiffness_slope, damping_slope] = model.diagonal(k, p, |law| model.derivative(law, p, Parameter::Friction))?;
    let pad_participation = match (model.pad_mass(), model.pad_modes()) {
        (Some(mass), _) => mass[(k, k)].clamp(0.0, 1.0),
        (None, Some(pad_modes)) => f64::from(u8::from(k < pad_modes)),
        (None, None) => f64::NAN,
    };
    let mut push = |lambda: c64, square: c64| {
        // Value of `λ² + c λ + k` and its derivative at the computed root, with the rounding of its coefficients and
        // of its terms.
        let off = square + damping * lambda + stiffness;
        let weight = if of.undamped { c64::ONE } else { 2.0 * lambda + damping };
        let size = square.norm() + damping.abs() * lambda.norm() + stiffness.abs();
        let rounding = ROUNDING * f64::EPSILON * size;
        let error = match (vectors, of.undamped) {
            (Vectors::None | Vectors::Right, _) => RootError::UNKNOWN,
            (Vectors::Both, true) => RootError::from_square(lambda, rounding, true),
            // The root nearer to zero of `δ² + w δ + η = 0`.
            (Vectors::Both, false) => {
                RootError::from_lambda(lambda, rounding.sqrt().min(2.0 * rounding / weight.norm()))
            }
        };
        let residual = match vectors {
            Vectors::None => f64::NAN,
            _ if off == c64::ZERO => 0.0,
            _ => off.norm() / size,
        };
        // At a double root neither has a derivative; the sensitivity is set to zero.
        let left = if weight == c64::ZERO { c64::ZERO } else { weight.inv().conj() };
        let change = lambda * damping_slope + stiffness_slope;
        let sensitivity = -left.conj() * change * if of.undamped { c64::ONE } else { 2.0 * lambda };
        let root = Root { lambda, square, residual, pad_participation, error };
        out.push(Entry { root, column: Column::Alone(k, left), sensitivity });
    };
    let half = -0.5 * damping;
    let discriminant = half * half - stiffness;
    if of.undamped {
        let square = c64::new(0.0 - stiffness, 0.0);
        push(square_root(square), square);
    } else if discriminant < 0.0 {
        let lambda = c64::new(half, (-discriminant).sqrt());
        push(lambda, lambda * lambda);
    } else {
        // The root of larger magnitude first, without cancellation; the other follows from their product.
        let larger = half + discriminant.sqrt().copysign(half);
        let smaller = if larger == 0.0 { 0.0 } else { stiffness / larger };
        for lambda in [larger, smaller] {
            push(c64::new(lambda, 0.0), c64::new(lambda * lambda, 0.0));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::law::ContactLaw;
    use super::super::model::ContactPairs;
    use super::super::solver::Solver;
    use super::super::stability_map::{MapOptions, StabilityMap};
    use super::super::test_models::REFERENCE;
    use super::*;
    use crate::proof::synthetic::Uniform;

    /// Ten modes on three contact pairs. Those in `untouched` have zero contact rows. Mode 8 is free, mode 9
    /// overdamped.
    fn rig(untouched: &[usize], damping_ratio: f64) -> Model {
        let mut uniform = Uniform::new(4);
        let omega: Vec<f64> = (0..10).map(|k| if k == 8 { 0.0 } else { 1.0 + 0.4 * f64::from(k) }).collect();
        let mut rows = || {
            let rows = Mat::from_fn(3, 10, |_, _| uniform.draw());
            Mat::from_fn(3, 10, |i, k| if untouched.contains(&k) { 0.0 } else { rows[(i, k)] })
        };
        let pairs = ContactPairs {
            normal: rows(),
            sliding: rows(),
            lateral: rows(),
            stiffness_n_per_m: vec![2.0; 3],
            damping_n_s_per_m: vec![0.0; 3],
            radius_m: vec![0.1; 3],
        };
        let diagonal = |value: &dyn Fn(usize) -> f64| Term {
            matrix: Mat::from_fn(10, 10, |i, j| if i == j { value(i) } else { 0.0 }),
            law: Law::Constant,
        };
        let stiffness = vec![diagonal(&|k| omega[k] * omega[k])];
        let damping = vec![diagonal(&|k| if k == 9 { 1500.0 } else { 4.0 } * damping_ratio)];
        let model = Model::new(10, stiffness, damping, ContactLaw::default(), Some(5));
        model.and_then(|model| model.with_contact(&pairs)).expect("the rig is well formed")
    }

    /// Roots, shapes and sensitivities agree with those of the undivided problem, and the map is complete.
    #[test]
    fn the_rest_is_the_whole() {
        for damping_ratio in [0.0, 1e-2] {
            let model = rig(&[2, 6, 8, 9], damping_ratio);
            assert_eq!((model.decoupled_count(), rig(&[], damping_ratio).decoupled_count()), (4, 0));
            let mut solver = Solver::new(10);
            for step in 0..50 {
                let p = REFERENCE.with_friction(0.04 * f64::from(step));
                let damped = damping_ratio > 0.0;
                let here = model.at(&p).expect("a finite operating point");
                let whole = solver.solve_coupled(&model, &here, Vectors::Both, damped).expect("it solves");
                let parted = solver.solve(&model, &p, Vectors::Both).expect("it solves");
                assert_eq!((parted.roots.len(), parted.mode_count), (whole.roots.len(), whole.mode_count));
                for (j, root) in parted.roots.iter().enumerate() {
                    // Equal frequencies of a growing and a decaying mode may be listed in either order.
                    let off = |k: &usize| (whole.roots[*k].lambda - root.lambda).norm();
                    let k = (0..whole.roots.len()).min_by(|a, b| off(a).total_cmp(&off(b))).expect("roots");
                    let (other, limit) = (&whole.roots[k], whole.roots[k].error.omega + root.error.omega);
                    assert!(off(&k) <= limit && root.residual < 1e-12, "{root:?} is not {other:?}");
                    if limit > 1e-10 || root.lambda == c64::ZERO {
                        continue; // at a merging point, or the double root of a free mode: nothing to compare the rest by
                    }
                    let overlap: c64 = (0..10).map(|i| whole.shapes[(i, k)].conj() * parted.shapes[(i, j)]).sum();
                    assert!((overlap.norm() - 1.0).abs() < 1e-8, "{overlap} at {root:?}");
                    let moved = (whole.friction_sensitivity[k] - parted.friction_sensitivity[j]).norm();
                    assert!(moved < 1e-7 * (1.0 + parted.friction_sensitivity[j].norm()), "{moved:e} at {root:?}");
                    assert!((other.pad_participation - root.pad_participation).abs() < 1e-8);
                    // With `y`, the change of a root due to a change of any one matrix entry is the same.
                    let left = |s: &Spectrum, k: usize| s.left[(3, k)].conj() * s.shapes[(6, k)];
                    assert!((left(&whole, k) - left(&parted, j)).norm() < 1e-8, "left vector at {root:?}");
                }
            }
            let options =
                MapOptions { mu_min: 0.0, mu_max: 2.0, band_max_hz: None, instability_threshold: 1e-6, windows: true };
            let map = StabilityMap::build(&model, &mut solver, &REFERENCE, &options).expect("it can be mapped");
            let touched = map.windows.iter().flat_map(|window| &window.mode_ids);
            assert!(map.complete && touched.count() > 0, "{:?}", map.windows);
        }
    }

    /// `λ² + cλ + k = 0` solved by hand, next to a coupled pair: underdamped, overdamped, free, divergent.
    #[test]
    fn by_hand() {
        let coupled = [[4.0, 1.0], [1.0, 9.0]];
        for (k, c, expected) in [
            (25.0, 6.0, [c64::new(-3.0, 4.0), c64::new(-3.0, 4.0)]),
            (4.0, 5.0, [c64::new(-1.0, 0.0), c64::new(-4.0, 0.0)]),
            (0.0, 2.0, [c64::new(0.0, 0.0), c64::new(-2.0, 0.0)]),
            (-9.0, 0.0, [c64::new(3.0, 0.0), c64::new(-3.0, 0.0)]),
        ] {
            let of = |pair: [[f64; 2]; 2], own: f64| Term {
                matrix: Mat::from_fn(3, 3, |i, j| match (i, j) {
                    (2, 2) => own,
                    (2, _) | (_, 2) => 0.0,
                    _ => pair[i][j],
                }),
                law: Law::Constant,
            };
            let damping = of([[0.1, 0.0], [0.0, 0.1]], c);
            let model = Model::new(3, vec![of(coupled, k)], vec![damping], ContactLaw::default(), None).unwrap();
            assert_eq!(model.decoupled_count(), 1);
            let spectrum = Solver::new(3).solve(&model, &REFERENCE, Vectors::Both).unwrap();
            for expected in expected {
                let near = |root: &&Root| (root.lambda - expected).norm() <= root.error.omega;
                assert!(spectrum.roots.iter().any(|root| near(&root)), "{expected} is not in {:?}", spectrum.roots);
            }
        }
    }
}
