//! A figure of the largest growth rate over two conditions, with the edges of the windows of instability.

use plotters::prelude::*;

use super::plot::{FINE, PlotError, axes, failed, figure, legend_text};

/// Number of classes of growth rates.
pub(super) const CLASSES: usize = 6;
/// Colours of the slowest and the fastest class.
const SLOW: [f64; 3] = [254.0, 232.0, 200.0];
const FAST: [f64; 3] = [153.0, 0.0, 13.0];
/// Fill of operating points without a prediction.
const FAULT: RGBColor = RGBColor(150, 150, 150);

/// A condition along an axis.
#[derive(Clone, Debug)]
pub struct Axis {
    pub label: &'static str,
    /// Ascending, evenly spaced.
    pub values: Vec<f64>,
}

/// What happens at an operating point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cell {
    Stable,
    /// A mode grows with this rate, 1/s.
    Growing(f64),
    /// There is no prediction.
    Fault,
}

/// Whether instability begins or ends at an edge, in the direction of the growing condition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Edge {
    Begins,
    Ends,
}

/// The largest growth rate over two conditions.
#[derive(Clone, Debug)]
pub struct Plane {
    pub x: Axis,
    pub y: Axis,
    /// Rows along x, one for each value of y.
    pub rows: Vec<Vec<Cell>>,
    /// Edges of the windows: x, y and kind.
    pub edges: Vec<(f64, f64, Edge)>,
}

/// Draws the plane: fill by growth rate in classes of equal ratio, black dots where instability begins, white ones where it
/// ends.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn draw(title: &str, plane: &Plane) -> Result<String, PlotError> {
    let cells = || plane.rows.iter().flatten();
    let growing = || cells().filter_map(|cell| if let Cell::Growing(rate) = cell { Some(*rate) } else { None });
    let fastest = growing().fold(f64::NEG_INFINITY, f64::max);
    // At most four decades below the fastest are told apart.
    let slowest = growing().fold(f64::INFINITY, f64::min).max(1e-4 * fastest);
    let class = |rate: f64| {
        let share = (rate.max(slowest) / slowest).ln() / (fastest / slowest).ln();
        if share.is_finite() { ((share * CLASSES as f64) as usize).min(CLASSES - 1) } else { CLASSES - 1 }
    };
    let any = fastest.is_finite();
    let faults = cells().any(|cell| *cell == Cell::Fault);
    figure(title, (1000, 700), |area| {
        let (head, area) = area.split_vertically(54 * FINE);
        let mut entries: Vec<(RGBColor, String)> = vec![];
        if any {
            let limit = |k: usize| slowest * (fastest / slowest).powf(k as f64 / CLASSES as f64);
            entries.extend((0..CLASSES).map(|k| (colour(k), format!("to {} 1/s", rounded(limit(k + 1))))));
        }
        if faults {
            entries.push((FAULT, "no prediction".to_owned()));
        }
        for (k, (fill, label)) in entries.iter().enumerate() {
            let (x, y) = ((84 + 128 * k as i32) * FINE as i32, 12 * FINE as i32);
            let half = 8 * FINE as i32;
            let square =
                Rectangle::new([(x + 10 * FINE as i32, y - half), (x + 26 * FINE as i32, y + half)], fill.filled());
            head.draw(&square).map_err(failed)?;
            legend_text(&head, (x, y), label)?;
        }
        for (k, (edge, label)) in
            [(Edge::Begins, "instability begins"), (Edge::Ends, "instability ends")].into_iter().enumerate()
        {
            let (x, y) = ((84 + 200 * k as i32) * FINE as i32, 38 * FINE as i32);
            for dot in dot((x + 18 * FINE as i32, y), edge) {
                head.draw(&dot).map_err(failed)?;
            }
            legend_text(&head, (x, y), label)?;
        }
        let step = |axis: &Axis| {
            let (first, last) = (axis.values[0], axis.values[axis.values.len() - 1]);
            (first, last, (last - first) / (axis.values.len() - 1) as f64)
        };
        let ((x0, x1, dx), (y0, y1, dy)) = (step(&plane.x), step(&plane.y));
        let mut chart = axes(&area, (x0, x1), (y0, y1), plane.x.label, plane.y.label)?;
        // Neighbours of one colour along x are one rectangle.
        let mut filled: Vec<(RGBColor, [(f64, f64); 2])> = vec![];
        for (row, y) in plane.rows.iter().zip(&plane.y.values) {
            let (low, high) = ((y - 0.5 * dy).max(y0), (y + 0.5 * dy).min(y1));
            let mut before = None;
            for (cell, x) in row.iter().zip(&plane.x.values) {
                let fill = match cell {
                    Cell::Stable => None,
                    Cell::Growing(rate) => Some(colour(class(*rate))),
                    Cell::Fault => Some(FAULT),
                };
                let (left, right) = ((x - 0.5 * dx).max(x0), (x + 0.5 * dx).min(x1));
                match (fill, filled.last_mut()) {
                    (Some(_), Some((_, [_, end]))) if fill == before => end.0 = right,
                    (Some(fill), _) => filled.push((fill, [(left, low), (right, high)])),
                    (None, _) => {}
                }
                before = fill;
            }
        }
        let filled = filled.into_iter().map(|(fill, corners)| Rectangle::new(corners, fill.filled()));
        chart.draw_series(filled).map_err(failed)?;
        for &(x, y, edge) in &plane.edges {
            chart.draw_series(dot((x, y), edge)).map_err(failed)?;
        }
        Ok(())
    })
}

/// A dot, black or white with a black rim.
fn dot<C: Clone>(place: C, edge: Edge) -> [Circle<C, u32>; 2] {
    let inner = match edge {
        Edge::Begins => BLACK,
        Edge::Ends => WHITE,
    };
    [Circle::new(place.clone(), 5 * FINE / 2, BLACK.filled()), Circle::new(place, 3 * FINE / 2, inner.filled())]
}

/// Colour of a class.
pub(super) fn colour(class: usize) -> RGBColor {
    let share = class as f64 / (CLASSES - 1) as f64;
    let mixed = |k: usize| (SLOW[k] + share * (FAST[k] - SLOW[k])).round() as u8;
    RGBColor(mixed(0), mixed(1), mixed(2))
}

/// A rate with at least two digits.
fn rounded(rate: f64) -> String {
    crate::text::number::significant(rate, 1 + rate.abs().log10().floor().max(1.0) as usize)
}
