//! The precisions in which a factor is kept.
//!
//! A factor is computed in double precision. Kept in single precision it takes half the memory; solves with it are then
//! refined in double precision (`refinement`).

/// How the numbers of a factor are kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 8 bytes, 16 digits.
    Double,
    /// 4 bytes, 7 digits; solves are refined.
    Single,
}

impl Precision {
    /// Bytes of one number.
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::Double => size_of::<f64>(),
            Self::Single => size_of::<f32>(),
        }
    }
}

/// A number of a factor.
pub(super) trait Real: faer::traits::RealField + Copy {
    /// The same number in double precision.
    fn double(self) -> f64;
}

impl Real for f64 {
    fn double(self) -> f64 {
        self
    }
}

impl Real for f32 {
    fn double(self) -> f64 {
        f64::from(self)
    }
}

/// The numbers of a factor, in the layout of its supernodes.
pub(super) enum Values {
    Double(Vec<f64>),
    Single(Vec<f32>),
}

impl Values {
    /// Zeros, or `None` if memory is insufficient.
    pub(super) fn zeros(length: usize, precision: Precision) -> Option<Self> {
        match precision {
            Precision::Double => zeros(length).map(Self::Double),
            Precision::Single => zeros(length).map(Self::Single),
        }
    }
}

/// Zeros, or `None` if memory is insufficient.
pub(super) fn zeros<T: Real>(length: usize) -> Option<Vec<T>> {
    let mut values = vec![];
    values.try_reserve_exact(length).ok()?;
    values.resize(length, T::zero());
    Some(values)
}
