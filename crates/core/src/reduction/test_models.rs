//! Small full models shared by the tests of this module.

use faer::sparse::Triplet;

use super::{FullContact, FullModel, FullPart, SparseMatrix};
use crate::physics::ContactLaw;

/// A grounded chain of `count` masses with springs of about `spring`, N/m; masses and springs vary along the chain.
fn chain(name: &str, count: usize, spring: f64) -> FullPart {
    let (mut mass, mut stiffness) = (vec![], vec![]);
    for i in 0..count {
        mass.push(Triplet::new(i, i, 1.0 + 0.3 * (i as f64).sin()));
        let k = spring * (1.0 + 0.2 * (1.7 * i as f64).cos());
        stiffness.push(Triplet::new(i, i, k));
        if i > 0 {
            stiffness.extend([Triplet::new(i - 1, i - 1, k), Triplet::new(i, i - 1, -k), Triplet::new(i - 1, i, -k)]);
        }
    }
    let build = |t: &[_]| SparseMatrix::try_new_from_triplets(count, count, t).unwrap();
    FullPart { name: name.to_owned(), mass: build(&mass), stiffness: build(&stiffness) }
}

/// Two chains of 40 and 35 masses with three contact pairs.
pub fn chains(damping: f64, contact_law: ContactLaw) -> FullModel {
    let (pad, disc) = (chain("pad", 40, 4e6), chain("disc", 35, 5e6));
    let row = |a: usize, b: usize| vec![(a, 1.0), (40 + b, -1.0)];
    FullModel {
        parts: vec![pad, disc],
        stiffness: vec![],
        damping: vec![],
        modal_damping: vec![],
        contact: Some(FullContact {
            steady: None,
            normal: vec![row(12, 9), row(22, 18), row(33, 30)],
            sliding: vec![row(13, 11), row(20, 19), row(35, 28)],
            lateral: vec![row(5, 4), row(17, 16), row(38, 33)],
            stiffness_n_per_m: vec![9e5, 7e5, 8e5],
            damping_n_s_per_m: vec![damping; 3],
            radius_m: vec![0.09, 0.1, 0.11],
        }),
        contact_law,
    }
}
