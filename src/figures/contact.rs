//! A figure of the contact: the force of every pair, at its place on the interface or by number.

use plotters::prelude::*;

use super::plot::{COLOURS, FINE, PlotError, axes, failed, figure, legend_text, padded};

/// Largest radius of a dot, px.
const LARGEST_DOT: f64 = 14.0;
/// Radius of the ring of an open pair, px.
const OPEN_RING: u32 = 4;

/// A pair: its place and force.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dot {
    /// mm along the motion of the disc and mm outward; `None` if the place is not known.
    pub place_mm: Option<(f64, f64)>,
    /// 0 where the pair is open.
    pub force_n: f64,
}

/// Draws the pairs as dots whose area is the force, at their places; or, if a place is not known, their forces by number.
/// Rings are open pairs.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn draw(dots: &[Dot]) -> Result<String, PlotError> {
    let largest = dots.iter().map(|dot| dot.force_n).fold(0.0, f64::max);
    let places: Option<Vec<(f64, f64)>> = dots.iter().map(|dot| dot.place_mm).collect();
    let range = |values: &[f64]| {
        let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        padded((low, high))
    };
    figure("", (1000, 420), |area| {
        let (head, area) = area.split_vertically(26 * FINE);
        let row = 12 * FINE as i32;
        let at = |px: i32| (px * FINE as i32, row);
        head.draw(&Circle::new(at(102), 6 * FINE, COLOURS[0].filled())).map_err(failed)?;
        legend_text(&head, at(84), &format!("force, largest {largest:.1} N"))?;
        head.draw(&Circle::new(at(402), OPEN_RING * FINE, BLACK.stroke_width(FINE))).map_err(failed)?;
        legend_text(&head, at(384), "open pair")?;
        let (centres, mut chart) = match &places {
            Some(places) => {
                let (along, outward): (Vec<f64>, Vec<f64>) = places.iter().copied().unzip();
                let labels = ("mm along the motion of the disc; leading edge on the left", "mm outward");
                (places.clone(), axes(&area, range(&along), range(&outward), labels.0, labels.1)?)
            }
            None => {
                let of_force = dots.iter().enumerate().map(|(k, dot)| ((k + 1) as f64, dot.force_n)).collect();
                let x = (0.5, dots.len() as f64 + 0.5);
                (of_force, axes(&area, x, (0.0, 1.08 * largest.max(1e-9)), "contact pair", "force, N")?)
            }
        };
        for (dot, centre) in dots.iter().zip(centres) {
            if dot.force_n <= 0.0 {
                let ring = Circle::new(centre, OPEN_RING * FINE, BLACK.stroke_width(FINE));
                chart.draw_series([ring]).map_err(failed)?;
                continue;
            }
            let share = dot.force_n / largest;
            let radius = if places.is_some() { LARGEST_DOT * share.sqrt() } else { 5.0 };
            let size = (radius * f64::from(FINE)).round().max(1.0) as u32;
            if places.is_none() {
                let stalk = LineSeries::new([(centre.0, 0.0), centre], COLOURS[0].stroke_width(2 * FINE));
                chart.draw_series(stalk).map_err(failed)?;
            }
            chart.draw_series([Circle::new(centre, size, COLOURS[0].filled())]).map_err(failed)?;
        }
        Ok(())
    })
}
