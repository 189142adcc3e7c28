//! Predicts squeal from matrices in memory: two modes of a pad and two of a disc, joined by two contact pairs.
//!
//! ```sh
//! cargo run -p squealcast-core --example predict_from_matrices
//! ```

use std::error::Error;
use std::f64::consts::TAU;

use faer::{Mat, mat};
use squealcast_core::physics::{
    ContactLaw, ContactPairs, Law, MapOptions, Model, OperatingPoint, Solver, StabilityMap, Term, Vectors,
};

fn main() -> Result<(), Box<dyn Error>> {
    // Natural frequencies of the free parts, pad first; damping ratio 0.1 % each. Coordinates are mass-normalised.
    let omega = [1900.0, 2300.0, 2000.0, 2250.0].map(|hz| TAU * hz);
    let diagonal = |value: &dyn Fn(f64) -> f64| Term {
        matrix: Mat::from_fn(4, 4, |i, j| if i == j { value(omega[i]) } else { 0.0 }),
        law: Law::Constant,
    };
    let (stiffness, damping) = (diagonal(&|w| w * w), diagonal(&|w| 2.0 * 1e-3 * w));

    // Relative displacement of each pair, pad minus disc: a row for each pair, a column for each mode, kg^-1/2.
    let pairs = ContactPairs {
        normal: mat![[0.9, 0.3, -1.0, -0.4], [0.7, -0.4, -0.8, 0.5]],
        sliding: mat![[0.1, 0.8, -0.1, 0.3], [-0.2, 0.7, 0.4, -0.1]],
        lateral: Mat::zeros(2, 4),
        stiffness_n_per_m: vec![2e7; 2],
        damping_n_s_per_m: vec![0.0; 2],
        radius_m: vec![0.1; 2],
    };
    let model = Model::new(4, vec![stiffness], vec![damping], ContactLaw::default(), Some(2))?.with_contact(&pairs)?;

    let at = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.4 };
    let mut solver = Solver::new(model.dimension());
    let spectrum = solver.solve(&model, &at, Vectors::Both)?;
    println!("modes at {} N, {} rad/s, mu = {}:", at.normal_load_n, at.disc_speed_rad_s, at.friction_coefficient);
    for mode in spectrum.modes() {
        println!("  {:8.2} Hz  growth rate {:9.3} 1/s", mode.lambda.im / TAU, mode.lambda.re);
    }

    let options =
        MapOptions { mu_min: 0.0, mu_max: 1.0, band_max_hz: None, instability_threshold: 1e-6, windows: true };
    let map = StabilityMap::build(&model, &mut solver, &at, &options)?;
    match map.critical_friction() {
        Some(critical) => println!("squeal from mu = {critical:.6}"),
        None => println!("no squeal up to mu = {}", options.mu_max),
    }
    Ok(())
}
