//! Figures, all with one look: axes with units, print-ready SVG.

use std::collections::BTreeMap;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use crate::display::curves::Curves;
use crate::display::history::{Bin, History};
use crate::physics::Window;
use crate::wire::level;

/// Width and height of a figure, px.
const SIZE: (u32, u32) = (1000, 900);
/// The library places points on whole units; this many to a px keeps curves smooth.
const FINE: u32 = 8;
/// Colours of neighbouring curves; told apart by the colour-blind too (Okabe and Ito, 2008).
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(60, 60, 60),
];

/// One mode at one friction coefficient.
#[derive(Clone, Copy, Debug)]
pub struct Point {
    pub mu: f64,
    pub id: u32,
    pub frequency_hz: f64,
    pub growth_rate_per_s: f64,
}

/// Why a figure could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw the figure: {0}")]
pub struct PlotError(String);

/// Frequencies and growth rates of followed modes against the friction coefficient, one above the other, with the
/// windows of instability shaded.
///
/// # Errors
/// [`PlotError`] where the drawing library refuses.
pub fn sweep(title: &str, points: &[Point], windows: &[Window]) -> Result<String, PlotError> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (SIZE.0 * FINE, SIZE.1 * FINE)).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        let area = area.margin(8 * FINE, 0, 0, 0).titled(title, ("sans-serif", 22 * FINE)).map_err(failed)?;
        let (upper, lower) = area.split_vertically(55.percent());
        panel(&upper, points, windows, "frequency, Hz", |p| p.frequency_hz)?;
        panel(&lower, points, windows, "growth rate, 1/s", |p| p.growth_rate_per_s)?;
        area.present().map_err(failed)?;
    }
    let fine = format!("width=\"{}\" height=\"{}\"", SIZE.0 * FINE, SIZE.1 * FINE);
    Ok(svg.replacen(&fine, &format!("width=\"{}\" height=\"{}\"", SIZE.0, SIZE.1), 1))
}

/// Growth rates and frequencies of a stability map against the friction coefficient, windows shaded, `mu` marked.
///
/// # Errors
/// [`PlotError`] where the drawing library refuses.
pub fn map(title: &str, curves: &Curves, mu: f64) -> Result<String, PlotError> {
    let last = curves.mu.last().copied().unwrap_or(1.0);
    let wanted = [1.6 * curves.critical_friction.unwrap_or(last), 1.15 * mu, 0.05];
    let end = wanted.into_iter().filter(|mu| mu.is_finite()).fold(0.0, f64::max).min(last);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (SIZE.0, 640)).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        let area = if title.is_empty() { area } else { area.titled(title, ("sans-serif", 22)).map_err(failed)? };
        let (upper, lower) = area.split_vertically(50.percent());
        for (area, label, growth) in [(&upper, "growth rate, 1/s", true), (&lower, "frequency, Hz", false)] {
            let lines: Vec<(u32, Vec<(f64, f64)>)> = curves
                .modes
                .iter()
                .map(|mode| {
                    let values = if growth { &mode.growth_rate_per_s } else { &mode.frequency_hz };
                    let points = curves.mu.iter().zip(values).filter(|(mu, _)| **mu <= end);
                    (mode.id, points.filter_map(|(mu, value)| Some((*mu, f64::from((*value)?)))).collect())
                })
                .collect();
            let y = padded(range(lines.iter().flat_map(|(_, points)| points.iter().map(|point| point.1))));
            let mut chart = axes(area, (0.0, end), y, "friction coefficient", label)?;
            for window in &curves.windows {
                let to = window.mu_to.unwrap_or(end).min(end);
                if window.mu_from < to {
                    let shade = RGBColor(213, 94, 0).mix(0.14).filled();
                    let corners = [(window.mu_from, y.0), (to, y.1)];
                    chart.draw_series([Rectangle::new(corners, shade)]).map_err(failed)?;
                }
            }
            for (id, points) in lines {
                let colour = COLOURS[id as usize % COLOURS.len()];
                chart.draw_series(LineSeries::new(points, colour.stroke_width(2))).map_err(failed)?;
            }
            if mu.is_finite() {
                let line = [(mu, y.0), (mu, y.1)];
                chart.draw_series(LineSeries::new(line, BLACK.stroke_width(2))).map_err(failed)?;
            }
        }
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

/// A session over time, in seconds after `from_s`: ranges of load, speed, friction, growth and margin, and the unstable
/// frequencies; shaded where squeal was predicted.
///
/// # Errors
/// [`PlotError`] where the drawing library refuses.
pub fn history(title: &str, history: &History, from_s: f64) -> Result<String, PlotError> {
    const LABELS: [&str; 5] = ["load, N", "speed, rad/s", "friction", "growth, 1/s", "margin"];
    let bin_s = history.bin_ns() as f64 * 1e-9;
    let at = |index: i64| index as f64 * bin_s - from_s;
    let ends = history.bins().front().zip(history.bins().back());
    let time = ends.map_or((0.0, 1.0), |(first, last)| (at(first.index).min(0.0), at(last.index + 1)));
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (SIZE.0, 1150)).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        let area = if title.is_empty() { area } else { area.titled(title, ("sans-serif", 22)).map_err(failed)? };
        let panels = area.split_evenly((LABELS.len() + 1, 1));
        for (k, area) in panels.iter().enumerate() {
            let label = LABELS.get(k).copied().unwrap_or("unstable, Hz");
            let unstable =
                || history.bins().iter().flat_map(|bin| bin.unstable.iter().map(move |mode| (bin.index, mode.0)));
            let y = padded(match LABELS.get(k) {
                Some(_) => {
                    let ranges = history.bins().iter().filter_map(|bin| bin.ranges[k]);
                    range(ranges.flat_map(|(low, high)| [f64::from(low), f64::from(high)]))
                }
                None => range(unstable().map(|(_, hz)| f64::from(hz))),
            });
            let mut chart = axes(area, time, y, if k == LABELS.len() { "time, s" } else { "" }, label)?;
            let bar = |index: i64, low: f64, high: f64, style: ShapeStyle| {
                Rectangle::new([(at(index), low), (at(index + 1), high)], style)
            };
            let shade = RGBColor(213, 94, 0).mix(0.12).filled();
            let squeals = stretches(history, |bin| (bin.level == level::SQUEAL).then_some(()));
            let shades = squeals.iter().filter_map(|stretch| {
                let (first, last) = (stretch.first()?.0, stretch.last()?.0);
                Some(Rectangle::new([(at(first), y.0), (at(last + 1), y.1)], shade))
            });
            chart.draw_series(shades).map_err(failed)?;
            let colour = COLOURS[if k == 3 { 1 } else { 0 }];
            if k < LABELS.len() {
                for stretch in stretches(history, |bin| bin.ranges[k]) {
                    let side = |of: fn((f32, f32)) -> f32| {
                        let point =
                            move |&(index, range): &(i64, (f32, f32))| (at(index) + 0.5 * bin_s, f64::from(of(range)));
                        stretch.iter().map(point).collect::<Vec<_>>()
                    };
                    let (low, high) = (side(|range| range.0), side(|range| range.1));
                    let outline: Vec<_> = low.iter().chain(high.iter().rev()).copied().collect();
                    chart.draw_series([Polygon::new(outline, colour.mix(0.35))]).map_err(failed)?;
                    for edge in [low, high] {
                        chart.draw_series(LineSeries::new(edge, colour.stroke_width(1))).map_err(failed)?;
                    }
                }
            } else {
                let half = 0.012 * (y.1 - y.0);
                let bars = unstable()
                    .map(|(index, hz)| bar(index, f64::from(hz) - half, f64::from(hz) + half, colour.filled()));
                chart.draw_series(bars).map_err(failed)?;
            }
        }
        area.present().map_err(failed)?;
    }
    Ok(svg)
}

/// Bins without a gap between them that all have something, with it.
fn stretches<T>(history: &History, of: impl Fn(&Bin) -> Option<T>) -> Vec<Vec<(i64, T)>> {
    let mut stretches: Vec<Vec<(i64, T)>> = vec![];
    for bin in history.bins() {
        let Some(value) = of(bin) else { continue };
        match stretches.last_mut().filter(|stretch| stretch.last().is_some_and(|last| last.0 + 1 == bin.index)) {
            Some(stretch) => stretch.push((bin.index, value)),
            None => stretches.push(vec![(bin.index, value)]),
        }
    }
    stretches
}

type Chart<'a> = ChartContext<'a, SVGBackend<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Axes with units, the same for every figure.
fn axes<'a>(
    area: &Area<'a>,
    x: (f64, f64),
    y: (f64, f64),
    x_label: &str,
    y_label: &str,
) -> Result<Chart<'a>, PlotError> {
    let mut chart = ChartBuilder::on(area)
        .margin(if x_label.is_empty() { 6 } else { 14 })
        .margin_right(30)
        .x_label_area_size(if x_label.is_empty() { 24 } else { 44 })
        .y_label_area_size(84)
        .build_cartesian_2d(x.0..x.1, y.0..y.1)
        .map_err(failed)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(RGBColor(225, 225, 225))
        .x_desc(x_label)
        .y_desc(y_label)
        .y_labels(5)
        .label_style(("sans-serif", 15))
        .axis_desc_style(("sans-serif", 17))
        .draw()
        .map_err(failed)?;
    Ok(chart)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn panel(
    area: &Area<'_>,
    points: &[Point],
    windows: &[Window],
    label: &str,
    value: impl Fn(&Point) -> f64,
) -> Result<(), PlotError> {
    let (mu, y) = (range(points.iter().map(|p| p.mu)), padded(range(points.iter().map(&value))));
    let mut chart = ChartBuilder::on(area)
        .margin(14 * FINE)
        .x_label_area_size(44 * FINE)
        .y_label_area_size(84 * FINE)
        .build_cartesian_2d(mu.0..mu.1, y.0..y.1)
        .map_err(failed)?;
    for window in windows.iter().filter(|window| window.mu_from < mu.1 && window.mu_to.is_none_or(|to| to > mu.0)) {
        let corners = [(window.mu_from.max(mu.0), y.0), (window.mu_to.unwrap_or(mu.1).min(mu.1), y.1)];
        chart.draw_series([Rectangle::new(corners, RGBColor(213, 94, 0).mix(0.08).filled())]).map_err(failed)?;
    }
    chart
        .configure_mesh()
        .axis_style(BLACK.stroke_width(FINE))
        .set_all_tick_mark_size(5 * FINE)
        .light_line_style(TRANSPARENT)
        .bold_line_style(RGBColor(225, 225, 225).stroke_width(FINE))
        .x_desc("friction coefficient")
        .y_desc(label)
        .label_style(("sans-serif", 15 * FINE))
        .axis_desc_style(("sans-serif", 17 * FINE))
        .draw()
        .map_err(failed)?;
    let mut curves: BTreeMap<u32, Vec<(f64, f64)>> = BTreeMap::new();
    for point in points {
        curves.entry(point.id).or_default().push((point.mu, value(point)));
    }
    for (id, curve) in curves {
        let colour = COLOURS[id as usize % COLOURS.len()];
        chart.draw_series(LineSeries::new(curve, colour.stroke_width(2 * FINE))).map_err(failed)?;
    }
    Ok(())
}

/// Smallest and largest of `values`; something to draw on where there is nothing.
fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    match (low < high, low.is_finite()) {
        (true, _) => (low, high),
        (false, true) => (low - 0.5, low + 0.5),
        (false, false) => (0.0, 1.0),
    }
}

fn padded((low, high): (f64, f64)) -> (f64, f64) {
    let pad = 0.04 * (high - low);
    (low - pad, high + pad)
}

fn failed(error: impl std::fmt::Display) -> PlotError {
    PlotError(error.to_string())
}
