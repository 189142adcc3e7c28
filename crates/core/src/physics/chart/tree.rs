//! Trees of boxes: a box is split in two along an axis, holds a leaf, or has no expansion.

use super::MAX_AXES;

/// A node of a tree of boxes. The first node of a list of them is the root.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Branch {
    /// Split along an axis at a coordinate; `below` and `above` are indices of branches.
    Split { axis: usize, at: f64, below: usize, above: usize },
    /// Index of a leaf.
    Leaf(usize),
    /// Not converged: a dense solve is needed there.
    Dense,
    /// Not tried yet: a dense solve is needed there until it is.
    Pending,
}

/// Index of the leaf that contains the coordinates `x`; `None` where there is none.
pub(super) fn find(branches: &[Branch], x: &[f64; MAX_AXES]) -> Option<usize> {
    let mut slot = 0;
    loop {
        match branches[slot] {
            Branch::Split { axis, at, below, above } => slot = if x[axis] < at { below } else { above },
            Branch::Leaf(leaf) => return Some(leaf),
            Branch::Dense | Branch::Pending => return None,
        }
    }
}

impl Branch {
    /// The branch as words of a stored chart.
    pub fn words(self) -> [u64; 4] {
        match self {
            Self::Split { axis, at, below, above } => [axis as u64, at.to_bits(), below as u64, above as u64],
            Self::Leaf(leaf) => [u64::MAX, leaf as u64, 0, 0],
            Self::Dense => [u64::MAX, u64::MAX, 0, 0],
            Self::Pending => [u64::MAX, u64::MAX, 1, 0],
        }
    }

    /// Branch `k` of `count` of a tree over `axes` axes; `None` if the words do not describe one. The branches it splits
    /// into must follow it.
    pub fn from_words(words: [u64; 4], k: usize, count: usize, axes: usize) -> Option<Self> {
        let number = |word: u64| usize::try_from(word).ok();
        Some(match words {
            [u64::MAX, u64::MAX, 0, 0] => Self::Dense,
            [u64::MAX, u64::MAX, 1, 0] => Self::Pending,
            [u64::MAX, leaf, 0, 0] => Self::Leaf(number(leaf)?),
            [axis, at, below, above] => {
                let axis = number(axis).filter(|&axis| axis < axes)?;
                let behind = |other: &usize| *other > k && *other < count;
                let (below, above) = (number(below).filter(behind)?, number(above).filter(behind)?);
                Self::Split { axis, at: f64::from_bits(at), below, above }
            }
        })
    }

    /// Whether the branch refers to none but the first `leaves` leaves.
    pub fn is_within(self, leaves: usize) -> bool {
        match self {
            Self::Leaf(leaf) => leaf < leaves,
            Self::Split { .. } | Self::Dense | Self::Pending => true,
        }
    }
}
