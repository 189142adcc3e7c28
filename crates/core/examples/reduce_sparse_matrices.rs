//! Reduces sparse matrices of one's own to a model that holds over a range of conditions: two chains of masses in contact
//! stand for the finite-element matrices of pad and disc.
//!
//! ```sh
//! cargo run -p squealcast-core --example reduce_sparse_matrices
//! ```

use std::error::Error;

use faer::sparse::Triplet;
use squealcast_core::physics::{ContactLaw, OperatingPoint, Solver, Vectors};
use squealcast_core::reduction::{
    Counted, FullContact, FullModel, FullPart, FullSolver, FullVectors, OperatingBox, ParametricRequest, SparseMatrix,
    parametric_basis,
};

/// A chain, grounded at its first mass, of `count` masses of about 1 kg with springs of about `spring`, N/m.
fn chain(name: &str, count: usize, spring: f64) -> Result<FullPart, Box<dyn Error>> {
    let (mut mass, mut stiffness) = (vec![], vec![]);
    for i in 0..count {
        mass.push(Triplet::new(i, i, 1.0 + 0.3 * (i as f64).sin()));
        let k = spring * (1.0 + 0.2 * (1.7 * i as f64).cos());
        stiffness.push(triplet((i, i, k)));
        if i > 0 {
            stiffness.extend([(i - 1, i - 1, k), (i, i - 1, -k), (i - 1, i, -k)].map(triplet));
        }
    }
    let sparse = |entries: &[_]| SparseMatrix::try_new_from_triplets(count, count, entries);
    let failed = |error| format!("{name}: {error:?}");
    Ok(FullPart {
        name: name.to_owned(),
        mass: sparse(&mass).map_err(failed)?,
        stiffness: sparse(&stiffness).map_err(failed)?,
    })
}

fn triplet((row, column, value): (usize, usize, f64)) -> Triplet<usize, usize, f64> {
    Triplet::new(row, column, value)
}

fn main() -> Result<(), Box<dyn Error>> {
    // Each contact pair is a linear form of the displacements: the row of the pad minus the row of the disc.
    let row = |pad: usize, disc: usize| vec![(pad, 1.0), (40 + disc, -1.0)];
    let contact_law =
        ContactLaw { exponent: 0.5, reference_n: 500.0, slope_s_per_m: -0.01, lateral_damping: true, stribeck: None };
    let full = FullModel {
        parts: vec![chain("pad", 40, 4e6)?, chain("disc", 35, 5e6)?],
        stiffness: vec![],
        damping: vec![],
        modal_damping: vec![],
        contact: Some(FullContact {
            steady: None,
            normal: vec![row(12, 9), row(22, 18), row(33, 30)],
            sliding: vec![row(13, 11), row(20, 19), row(35, 28)],
            lateral: vec![row(5, 4), row(17, 16), row(38, 33)],
            stiffness_n_per_m: vec![9e5, 7e5, 8e5],
            damping_n_s_per_m: vec![5.0; 3],
            radius_m: vec![0.09, 0.1, 0.11],
        }),
        contact_law,
    };

    let band_rad_s = 900.0;
    let request = ParametricRequest {
        range: OperatingBox {
            friction_coefficient: [0.0, 1.0],
            normal_load_n: [100.0, 1000.0],
            disc_speed_rad_s: [5.0, 20.0],
        },
        counted: Counted { band_rad_s, growth_floor_per_s: -20.0 },
        tolerance: 1e-6,
        training: 10,
        cutting: 40,
        held_out: 4,
        most_samples: 20,
        most_vectors: 70,
    };
    let mut full_solver = FullSolver::new("chains", &full, None, &mut |_| {})?;
    let basis = parametric_basis(&full, &mut full_solver, &request, &mut |_| {})?;
    let model = basis.projected.model(contact_law)?;
    println!("{} degrees of freedom reduced to {} coordinates", full.dimension(), model.dimension());
    println!("largest |dlambda| / |lambda| at {} held-out points: {:.1e}", basis.held_out.len(), basis.worst());

    let at = OperatingPoint { normal_load_n: 470.0, disc_speed_rad_s: 10.0, friction_coefficient: 0.45 };
    let of_full = full_solver.roots(&at, band_rad_s, FullVectors::None, &mut |_| {})?;
    let reduced = Solver::new(model.dimension()).solve(&model, &at, Vectors::None)?;
    println!("lowest roots, full and reduced:");
    for (full, reduced) in of_full.roots.iter().zip(reduced.modes()).take(5) {
        println!("  {:.9}  {:.9}", full.lambda, reduced.lambda);
    }
    Ok(())
}
