//! Products of Chebyshev polynomials of bounded total degree on a box, fitted to values, slopes and curvatures at scattered
//! points.

use faer::prelude::*;
use faer::{Mat, linalg::solvers::Qr};

use super::MAX_AXES;
use crate::chebyshev::polynomials;

/// Products of Chebyshev polynomials with a total degree of at most `degree`, in ascending order of degree.
#[derive(Clone, Debug, PartialEq)]
pub struct Basis {
    axes: usize,
    degree: usize,
    degrees: Vec<[u8; MAX_AXES]>,
}

/// Maximum total degree of a basis.
const MAX_DEGREE: usize = 24;

impl Basis {
    /// The basis of `axes` axes and total degree `degree`.
    pub fn new(axes: usize, degree: usize) -> Self {
        assert!(axes <= MAX_AXES && degree <= MAX_DEGREE, "{axes} axes of degree {degree}");
        let mut degrees = vec![];
        let range = |k: usize| 0..=if k < axes { degree as u8 } else { 0 };
        for (a, b, c) in range(0).flat_map(|a| range(1).flat_map(move |b| range(2).map(move |c| (a, b, c)))) {
            if usize::from(a) + usize::from(b) + usize::from(c) <= degree {
                degrees.push([a, b, c]);
            }
        }
        degrees.sort_by_key(|d| (total(d), std::cmp::Reverse(*d)));
        Self { axes, degree, degrees }
    }

    /// The basis used for a number of axes. Its degree is limited by the evaluation time.
    pub fn for_axes(axes: usize) -> Self {
        Self::new(
            axes,
            match axes {
                0 | 1 => 20,
                2 => 12,
                _ => 16,
            },
        )
    }

    /// Number of polynomials.
    pub fn len(&self) -> usize {
        self.degrees.len()
    }

    /// The highest total degree.
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Index range of the polynomials of total degree `degree`, which are contiguous.
    pub fn of_degree(&self, degree: usize) -> std::ops::Range<usize> {
        let below = |degree: usize| (0..self.axes).fold(1, |count, k| count * (degree + k) / (k + 1));
        below(degree)..below(degree + 1)
    }

    /// The sum of the magnitudes of all coefficients above total degree `degree`.
    pub fn beyond(&self, coefficients: &[f64], degree: usize) -> f64 {
        coefficients[self.of_degree(degree).end.min(coefficients.len())..].iter().map(|c| c.abs()).sum()
    }

    /// Values of the polynomials at `unit`, each coordinate in `[-1, 1]`.
    pub fn values(&self, unit: &[f64; MAX_AXES], out: &mut Vec<f64>) {
        let tables = unit.map(table);
        out.clear();
        out.extend(self.degrees.iter().map(|d| (0..self.axes).map(|k| tables[k][usize::from(d[k])]).product::<f64>()));
    }

    /// The data of a function at a point, each given by the order of its derivative along every axis: the value, the
    /// slopes and the second derivatives (that along axes `a ≤ b` at index `b (b + 1) / 2 + a` of the latter).
    pub fn orders(axes: usize) -> Vec<[usize; MAX_AXES]> {
        let along = |axes: &[usize]| std::array::from_fn(|k| axes.iter().filter(|&&axis| axis == k).count());
        let slopes = (0..axes).map(|axis| along(&[axis]));
        let curvatures = (0..axes).flat_map(|b| (0..=b).map(move |a| along(&[a, b])));
        std::iter::once([0; MAX_AXES]).chain(slopes).chain(curvatures).collect()
    }

    /// Derivatives of the polynomials at `unit`, of order `orders` along the axes; total order at most two.
    fn derivatives(&self, unit: &[f64; MAX_AXES], orders: &[usize; MAX_AXES], out: &mut Vec<f64>) {
        let tables: [_; MAX_AXES] = std::array::from_fn(|k| derivatives(unit[k])[orders[k]]);
        out.clear();
        out.extend(self.degrees.iter().map(|d| (0..self.axes).map(|k| tables[k][usize::from(d[k])]).product::<f64>()));
    }

    /// The axis along which the coefficients of the two highest degrees are largest.
    fn highest_axis(&self, coefficients: &[f64]) -> usize {
        let mut by_axis = [0.0; MAX_AXES];
        for (d, c) in self.degrees.iter().zip(coefficients).filter(|(d, _)| total(d) + 1 >= self.degree) {
            by_axis.iter_mut().zip(d).for_each(|(sum, &degree)| *sum += f64::from(degree) * c.abs());
        }
        (0..self.axes).max_by(|&a, &b| by_axis[a].total_cmp(&by_axis[b])).unwrap_or(0)
    }
}

fn total(degrees: &[u8; MAX_AXES]) -> usize {
    degrees.iter().map(|&d| usize::from(d)).sum()
}

/// `T_n(x)`, `T_n'(x)` and `T_n''(x)`, by the recurrence and its derivatives.
fn derivatives(x: f64) -> [[f64; MAX_DEGREE + 1]; 3] {
    let mut out = [table(x), [0.0; MAX_DEGREE + 1], [0.0; MAX_DEGREE + 1]];
    for order in 1..=2 {
        for n in 1..=MAX_DEGREE {
            let before = if n >= 2 { out[order][n - 2] } else { 0.0 };
            let doubled = if n == 1 { 1.0 } else { 2.0 };
            out[order][n] = doubled * (x * out[order][n - 1] + order as f64 * out[order - 1][n - 1]) - before;
        }
    }
    out
}

fn table(x: f64) -> [f64; MAX_DEGREE + 1] {
    let mut out = [0.0; MAX_DEGREE + 1];
    polynomials(x, &mut out);
    out
}

/// The expansion of a function.
pub struct Fitted {
    /// Coefficients of the basis.
    pub coefficients: Vec<f64>,
    /// Estimated truncation error: misfit plus tail. The misfit is the largest of any value, or of any derivative
    /// scaled to the value that the first omitted degree would have. The tail is the largest value of the terms of
    /// one of the two highest total degrees, over the points; the highest alone may be small by accident.
    pub missing: f64,
    /// The axis to split along. On three axes that of the largest second derivative with respect to the unit coordinates, over
    /// the points: next to a singularity second derivatives are unbounded, and largest along the axis along which it is nearest;
    /// the coefficients of an expansion that is far from converging do not tell. On fewer axes they do: the axis along which
    /// those of the two highest degrees are largest.
    pub worst_axis: usize,
}

/// A least-squares fit to values, slopes and curvatures at given points.
pub struct Fit {
    basis: Basis,
    rows: Mat<f64>,
    weights: Vec<f64>,
    /// Number of rows for each point.
    per_point: usize,
    qr: Qr<f64>,
}

impl Fit {
    /// A fit to data at `units`: at each point the data that [`Basis::orders`] lists, but only the value where it is
    /// not `sound`. `None` if the points do not determine the coefficients.
    pub fn new(basis: &Basis, units: &[[f64; MAX_AXES]], sound: &[bool]) -> Option<Self> {
        let orders = Basis::orders(basis.axes);
        let mut rows = Mat::zeros(units.len() * orders.len(), basis.len());
        let mut weights = vec![];
        let mut row = vec![];
        let degree = basis.degree.max(1) as f64;
        for (unit, &sound) in units.iter().zip(sound) {
            // The derivative of a polynomial with respect to `θ`, `x = cos θ`, is of the order of its degree
            // everywhere.
            let scale = unit.map(|x| (1.0 - x * x).max(0.0).sqrt().max(1.0 / degree) / degree);
            for order in &orders {
                basis.derivatives(unit, order, &mut row);
                let weight = (0..basis.axes).map(|k| scale[k].powi(order[k] as i32)).product();
                let weight = if sound || order.iter().all(|&times| times == 0) { weight } else { 0.0 };
                for (column, value) in row.iter().enumerate() {
                    rows[(weights.len(), column)] = weight * value;
                }
                weights.push(weight);
            }
        }
        let known = weights.iter().filter(|&&weight| weight > 0.0).count();
        if known < basis.len() {
            return None;
        }
        let qr = rows.qr();
        let pivot = |k: usize| qr.R()[(k, k)].abs();
        let smallest = (0..basis.len()).map(pivot).fold(f64::INFINITY, f64::min);
        (smallest > 1e-3 * pivot(0)).then_some(Self {
            basis: basis.clone(),
            rows,
            weights,
            per_point: orders.len(),
            qr,
        })
    }

    /// Expansions of the columns of `data`, with rows in the order given at [`Fit::new`].
    pub fn expand(&self, mut data: Mat<f64>) -> Vec<Fitted> {
        let curved: Vec<Option<usize>> = (0..data.ncols())
            .map(|column| (self.basis.axes == MAX_AXES).then(|| self.most_curved(&data, column)))
            .collect();
        for (row, &weight) in self.weights.iter().enumerate() {
            for column in 0..data.ncols() {
                // Omitted data may be NaN.
                data[(row, column)] = if weight > 0.0 { weight * data[(row, column)] } else { 0.0 };
            }
        }
        let coefficients = self.qr.solve_lstsq(&data);
        let last: Vec<Mat<f64>> = (self.basis.degree.saturating_sub(1)..=self.basis.degree)
            .map(|degree| self.basis.of_degree(degree))
            .map(|range| self.rows.get(.., range.clone()) * coefficients.get(range, ..))
            .collect();
        let fitted = &self.rows * &coefficients;
        let values = || (0..data.nrows()).step_by(self.per_point);
        (0..data.ncols())
            .map(|column| {
                let misfit = (0..data.nrows())
                    .map(|row| (fitted[(row, column)] - data[(row, column)]).abs())
                    .fold(0.0, f64::max);
                let size = |last: &Mat<f64>| values().map(|row| last[(row, column)].abs()).fold(0.0, f64::max);
                let tail = last.iter().map(size).fold(0.0, f64::max);
                let coefficients: Vec<f64> = (0..self.basis.len()).map(|row| coefficients[(row, column)]).collect();
                // `f64::max` ignores NaN, so NaN data must be reported explicitly.
                let missing = if coefficients[0].is_nan() { f64::NAN } else { misfit + tail };
                let worst_axis = curved[column].unwrap_or_else(|| self.basis.highest_axis(&coefficients));
                Fitted { coefficients, missing, worst_axis }
            })
            .collect()
    }

    /// The axis along which a column of the data curves most.
    fn most_curved(&self, data: &Mat<f64>, column: usize) -> usize {
        let axes = self.basis.axes;
        let curvature = |axis: usize| -> f64 {
            let twice = Basis::orders(axes).iter().position(|order| order[axis] == 2).unwrap_or(0);
            let rows = (twice..data.nrows()).step_by(self.per_point).filter(|&row| self.weights[row] > 0.0);
            rows.map(|row| data[(row, column)].abs()).fold(0.0, f64::max)
        };
        let curvatures: Vec<f64> = (0..axes).map(curvature).collect();
        (0..axes).max_by(|&a, &b| curvatures[a].total_cmp(&curvatures[b])).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::chart::samples::spread;

    /// An analytic function of three variables, fitted and evaluated at other points.
    #[test]
    fn fits_in_three_variables() {
        let f = |x: [f64; 3]| (0.7 * x[0] - 0.3 * x[1]).exp() / (5.0 + x[0] * x[1] + x[2]);
        let h = 1e-4;
        let slope = |f: &dyn Fn([f64; 3]) -> f64, x: [f64; 3], k: usize| {
            let (mut up, mut down) = (x, x);
            up[k] += h;
            down[k] -= h;
            (f(up) - f(down)) / (2.0 * h)
        };
        let basis = Basis::new(3, 8);
        let units = spread(3, &[], 25);
        let fit = Fit::new(&basis, &units, &[true; 25]).expect("the points determine it");
        let orders = Basis::orders(3);
        let data = Mat::from_fn(250, 1, |row, _| {
            let (unit, order) = (units[row / 10], orders[row % 10]);
            let axes: Vec<usize> = (0..3).flat_map(|k| std::iter::repeat_n(k, order[k])).collect();
            match *axes {
                [] => f(unit),
                [a] => slope(&f, unit, a),
                [a, b] => slope(&|x| slope(&f, x, a), unit, b),
                _ => unreachable!("at most two"),
            }
        });
        let fitted = fit.expand(data).remove(0);
        let mut values = vec![];
        for unit in [[0.3, -0.8, 0.1], [-0.99, 0.99, 0.99], [0.0, 0.5, -0.7]] {
            basis.values(&unit, &mut values);
            let sum: f64 = fitted.coefficients.iter().zip(&values).map(|(c, v)| c * v).sum();
            let bound = 4.0 * fitted.missing;
            assert!((sum - f(unit)).abs() < bound && bound < 1e-2, "{sum} is not {}: {bound:e}", f(unit));
        }
    }

    /// A function with a pole next to the box along one axis, and a basis far too small for it: it is the axis to split along,
    /// though it varies as much along another one.
    #[test]
    fn the_worst_axis_is_that_of_the_nearest_singularity() {
        let units = spread(3, &[], 25);
        let fit = Fit::new(&Basis::new(3, 8), &units, &[true; 25]).expect("the points determine it");
        let orders = Basis::orders(3);
        for pole in 0..3 {
            let steady = (pole + 1) % 3;
            // `1 / (1.02 - x) + 100 y`
            let data = Mat::from_fn(250, 1, |row, _| {
                let (unit, order) = (units[row / 10], orders[row % 10]);
                let away = 1.02 - unit[pole];
                let along = |times: usize| (0..3).all(|k| order[k] == if k == pole { times } else { 0 });
                match order.iter().sum::<usize>() {
                    0 => 1.0 / away + 100.0 * unit[steady],
                    1 if order[steady] == 1 => 100.0,
                    1 if along(1) => away.powi(-2),
                    2 if along(2) => 2.0 * away.powi(-3),
                    _ => 0.0,
                }
            });
            assert_eq!(fit.expand(data)[0].worst_axis, pole);
        }
    }
}
