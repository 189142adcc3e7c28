//! Figures as print-ready SVG, in a common style: axes with units, legends, shaded windows of instability.

use std::collections::BTreeMap;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::data::float::FloatPrettyPrinter;
use plotters::element::DashedPathElement;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::analysis::condition::Condition;
use crate::analysis::sweep::{Sweep, Swept};
use crate::display::curves::Curves;
use crate::display::history::{Bin, History};
use crate::evidence::bench::Route;
use crate::msgs::level;
use crate::physics::Window;
use crate::physics::identification::{Identified, Trial};

/// Drawing units per px. The plotting library rounds positions to whole units; a finer grid keeps curves smooth.
pub(super) const FINE: u32 = 8;
/// Colours of neighbouring curves, the same as on the page over white. They can be distinguished with colour blindness too.
pub(crate) const COLOURS: [RGBColor; 7] = [
    RGBColor(26, 53, 216),
    RGBColor(122, 0, 18),
    RGBColor(129, 89, 146),
    RGBColor(224, 106, 0),
    RGBColor(82, 145, 255),
    RGBColor(75, 4, 133),
    RGBColor(176, 60, 0),
];

/// Dash patterns that distinguish modes of the same colour: px drawn and px left out.
const DASHES: [Option<(u32, u32)>; 3] = [None, Some((8, 4)), Some((2, 3))];
/// Width of a legend, px, and its largest number of entries. More modes could not be distinguished.
const LEGEND_WIDTH: usize = 891;
const LEGEND_MOST: usize = 27;

/// A mode at one value of a condition: a point of its curve.
#[derive(Clone, Copy, Debug)]
pub struct Point {
    /// The condition: the friction coefficient, or the one that the figure names.
    pub x: f64,
    pub id: u32,
    pub frequency_hz: f64,
    pub growth_rate_per_s: f64,
}

/// Unit of the frequency axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    Hz,
    RadPerS,
}

/// A curve. Curves with the same label have the same style.
struct Line<'a> {
    style: u32,
    label: String,
    points: Vec<&'a Point>,
}

/// Label of the axis of the friction coefficient.
const FRICTION: &str = "friction coefficient";

/// Contents of a figure over one condition.
struct AgainstCondition<'a> {
    lines: Vec<Line<'a>>,
    dots: &'a [Point],
    windows: Vec<(f64, Option<f64>)>,
    x: (f64, f64),
    x_label: &'static str,
    /// A value of the condition marked by a vertical line.
    marked: Option<f64>,
    unit: Unit,
}

/// Why a figure could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw the figure: {0}")]
pub struct PlotError(String);

/// A range of a condition in which a mode is unstable; its end is `None` beyond the figure.
pub type Shaded = (f64, Option<f64>);

/// The modes of a sweep over `condition`, with those beside its windows, as points of curves.
pub fn swept(sweep: &Sweep, condition: Condition) -> Vec<Point> {
    let point = |swept: &Swept| Point {
        x: condition.of(&swept.place),
        id: swept.mode.id,
        frequency_hz: swept.mode.root.frequency_hz(),
        growth_rate_per_s: swept.mode.root.growth_rate_per_s(),
    };
    let mut points: Vec<Point> = sweep.modes.iter().chain(&sweep.beside_ends).map(point).collect();
    points.sort_by(|a, b| a.x.total_cmp(&b.x));
    points
}

/// Growth rates and frequencies of followed modes over a condition named `x_label`, in two panels, with shaded windows
/// of instability.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn sweep(title: &str, x_label: &'static str, points: &[Point], windows: &[Shaded]) -> Result<String, PlotError> {
    AgainstCondition {
        lines: by_mode(points),
        dots: &[],
        windows: windows.to_vec(),
        x: range(points.iter().map(|point| point.x)),
        x_label,
        marked: None,
        unit: Unit::Hz,
    }
    .draw(title)
}

/// Curves of one model as lines and of another as dots, up to `mu_max`. `windows` are those of the lines.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn against_full(
    title: &str,
    lines: &[Point],
    dots: &[Point],
    windows: &[Window],
    mu_max: f64,
    unit: Unit,
) -> Result<String, PlotError> {
    let windows = windows.iter().map(|window| (window.mu_from, window.mu_to)).collect();
    let x = (0.0, mu_max);
    AgainstCondition { lines: by_mode(lines), dots, windows, x, x_label: FRICTION, marked: None, unit }.draw(title)
}

/// Curves of several models as lines, with one style and legend entry per model, and of another model as dots.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn several(title: &str, models: &[(String, Vec<Point>)], dots: &[Point], mu_max: f64) -> Result<String, PlotError> {
    let lines = models.iter().enumerate().flat_map(|(k, (name, points))| {
        by_mode(points).into_iter().map(move |line| Line { style: k as u32, label: name.clone(), ..line })
    });
    let (lines, x) = (lines.collect(), (0.0, mu_max));
    AgainstCondition { lines, dots, windows: vec![], x, x_label: FRICTION, marked: None, unit: Unit::Hz }.draw(title)
}

/// One curve per mode.
fn by_mode(points: &[Point]) -> Vec<Line<'_>> {
    let mut modes: BTreeMap<u32, Vec<&Point>> = BTreeMap::new();
    for point in points {
        modes.entry(point.id).or_default().push(point);
    }
    modes.into_iter().map(|(id, points)| Line { style: id, label: format!("mode {id}"), points }).collect()
}

/// The curves of a stability map up to `mu_to`, drawn as by [`sweep`]. A line marks the friction coefficient `marked`.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn map(title: &str, curves: &Curves, mu_to: f64, marked: Option<f64>) -> Result<String, PlotError> {
    let windows = curves.windows.iter().map(|window| (window.mu_from, window.mu_to)).collect();
    let from = curves.mu.first().copied().unwrap_or(0.0);
    let (points, x) = (points(curves, mu_to), (from, mu_to.max(from + 1e-6)));
    let (lines, unit) = (by_mode(&points), Unit::Hz);
    AgainstCondition { lines, dots: &[], windows, x, x_label: FRICTION, marked, unit }.draw(title)
}

/// The points of curves up to `mu_to`.
pub fn points(curves: &Curves, mu_to: f64) -> Vec<Point> {
    let mut points = vec![];
    for mode in &curves.modes {
        for ((&mu, hz), growth) in curves.mu.iter().zip(&mode.frequency_hz).zip(&mode.growth_rate_per_s) {
            if let (Some(hz), Some(growth), true) = (*hz, *growth, mu <= mu_to) {
                let (frequency_hz, growth_rate_per_s) = (hz.into(), growth.into());
                points.push(Point { x: mu, id: mode.id, frequency_hz, growth_rate_per_s });
            }
        }
    }
    points
}

impl AgainstCondition<'_> {
    fn draw(&self, title: &str) -> Result<String, PlotError> {
        let x = self.x;
        let mut entries: Vec<(u32, &str)> = self.lines.iter().map(|line| (line.style, &*line.label)).collect();
        entries.dedup();
        let longest = entries.iter().map(|(_, label)| label.chars().count()).max().unwrap_or(0);
        let columns = (LEGEND_WIDTH / (43 + 8 * longest)).max(1);
        let rows = if entries.len() > LEGEND_MOST { 0 } else { entries.len().div_ceil(columns) as u32 };
        figure(title, (1000, 760 + 24 * rows), |area| {
            let (head, area) = area.split_vertically(24 * rows * FINE);
            if rows > 0 {
                legend(&head, &entries, columns)?;
            }
            let (upper, lower) = area.split_vertically(50.percent());
            let growth: fn(&Point) -> f64 = |point| point.growth_rate_per_s;
            let (frequency_label, frequency): (_, fn(&Point) -> f64) = match self.unit {
                Unit::Hz => ("frequency, Hz", |point| point.frequency_hz),
                Unit::RadPerS => ("frequency, rad/s", |point| std::f64::consts::TAU * point.frequency_hz),
            };
            for (area, label, value) in [(&upper, "growth rate, 1/s", growth), (&lower, frequency_label, frequency)] {
                let drawn = self.lines.iter().flat_map(|line| line.points.iter().copied()).chain(self.dots);
                let y = padded(range(drawn.map(value)));
                let mut chart = axes(area, x, y, self.x_label, label)?;
                for &(from, to) in &self.windows {
                    let (from, to) = (from.max(x.0), to.unwrap_or(x.1).min(x.1));
                    if from < to {
                        chart.draw_series([Rectangle::new([(from, y.0), (to, y.1)], shade())]).map_err(failed)?;
                    }
                }
                for line in &self.lines {
                    let points = line.points.iter().map(|point| (point.x, value(point))).collect();
                    curve(&mut chart, line.style, points)?;
                }
                let dot = |point: &Point| Circle::new((point.x, value(point)), 3 * FINE / 2, BLACK.filled());
                chart.draw_series(self.dots.iter().map(dot)).map_err(failed)?;
                if let Some(at) = self.marked.filter(|at| (x.0..=x.1).contains(at)) {
                    let line = LineSeries::new([(at, y.0), (at, y.1)], BLACK.stroke_width(2 * FINE));
                    chart.draw_series(line).map_err(failed)?;
                }
            }
            Ok(())
        })
    }
}

/// A session over time, in seconds after `from_s`: one panel each for the ranges of load, speed, friction coefficient,
/// growth rate, margin and (if measured) vibration level, and one for the unstable frequencies. Predicted squeal is
/// shaded. Dots are measured frequencies with a level of at least `threshold_db`.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn history(title: &str, history: &History, from_s: f64, threshold_db: f64) -> Result<String, PlotError> {
    const LABELS: [&str; 5] = ["load, N", "speed, rad/s", "friction", "growth, 1/s", "margin"];
    type Range = fn(&Bin) -> Option<(f32, f32)>;
    const RANGES: [Range; 5] =
        [|bin| bin.ranges[0], |bin| bin.ranges[1], |bin| bin.ranges[2], |bin| bin.ranges[3], |bin| bin.ranges[4]];
    let mut panels: Vec<(&str, RGBColor, Range)> =
        LABELS.into_iter().zip(RANGES).map(|(label, range)| (label, COLOURS[0], range)).collect();
    panels[3].1 = COLOURS[1];
    if history.bins().iter().any(|bin| bin.vibration.is_some()) {
        panels.push(("measured, dB", COLOURS[6], |bin| bin.vibration.map(|tone| (tone.low_db, tone.high_db))));
    }
    let bin_s = history.bin_ns() as f64 * 1e-9;
    let at = |index: i64| index as f64 * bin_s - from_s;
    let ends = history.bins().front().zip(history.bins().back());
    let time = ends.map_or((0.0, 1.0), |(first, last)| (at(first.index).min(0.0), at(last.index + 1)));
    let squeals = stretches(history, |bin| (bin.level == Some(level::SQUEAL)).then_some(()));
    let shades = |y: (f64, f64)| {
        let shaded = move |stretch: &Vec<(i64, ())>| {
            let (first, last) = (stretch.first()?.0, stretch.last()?.0);
            Some(Rectangle::new([(at(first), y.0), (at(last + 1), y.1)], shade()))
        };
        squeals.iter().filter_map(shaded).collect::<Vec<_>>()
    };
    figure(title, (1000, 190 * (panels.len() as u32 + 1)), |area| {
        let areas = area.split_evenly((panels.len() + 1, 1));
        for (area, (label, colour, of)) in areas.iter().zip(&panels) {
            let found = history.bins().iter().filter_map(of);
            let y = padded(range(found.flat_map(|(low, high)| [f64::from(low), f64::from(high)])));
            let mut chart = axes(area, time, y, "", label)?;
            chart.draw_series(shades(y)).map_err(failed)?;
            for stretch in stretches(history, of) {
                let side = |of: fn((f32, f32)) -> f32| {
                    let point =
                        move |&(index, range): &(i64, (f32, f32))| (at(index) + 0.5 * bin_s, f64::from(of(range)));
                    stretch.iter().map(point).collect::<Vec<_>>()
                };
                let (low, high) = (side(|range| range.0), side(|range| range.1));
                let outline: Vec<_> = low.iter().chain(high.iter().rev()).copied().collect();
                chart.draw_series([Polygon::new(outline, colour.mix(0.35))]).map_err(failed)?;
                for edge in [low, high] {
                    chart.draw_series(LineSeries::new(edge, colour.stroke_width(FINE))).map_err(failed)?;
                }
            }
        }
        let Some(area) = areas.last() else { return Ok(()) };
        let unstable = || {
            let modes = |bin: &Bin| {
                let index = bin.index;
                bin.unstable.into_iter().flatten().map(move |mode| (index, f64::from(mode.0)))
            };
            history.bins().iter().flat_map(modes).collect::<Vec<_>>()
        };
        let measured = || {
            let loud = |bin: &Bin| {
                let tone = bin.vibration.filter(|tone| f64::from(tone.high_db) >= threshold_db)?;
                Some((at(bin.index) + 0.5 * bin_s, f64::from(tone.frequency_hz)))
            };
            history.bins().iter().filter_map(loud).collect::<Vec<_>>()
        };
        let heights = unstable().into_iter().map(|mode| mode.1).chain(measured().into_iter().map(|tone| tone.1));
        let (low, high) = padded(range(heights));
        // A least height of the axis, so that a nearly constant frequency appears as a line and not as noise.
        let room = (0.05 * (low + high) - 0.5 * (high - low)).max(0.0);
        let y = (low - room, high + room);
        let mut chart = axes(area, time, y, "time, s", "unstable, Hz")?;
        chart.draw_series(shades(y)).map_err(failed)?;
        let half = 0.02 * (y.1 - y.0);
        let bars = unstable().into_iter().map(|(index, hz)| {
            Rectangle::new([(at(index), hz - half), (at(index + 1), hz + half)], COLOURS[0].filled())
        });
        chart.draw_series(bars).map_err(failed)?;
        let dot = |place| Circle::new(place, 3 * FINE / 2, BLACK.filled());
        chart.draw_series(measured().into_iter().map(dot)).map_err(failed)?;
        Ok(())
    })
}

/// A figure of the given width and height, px.
pub(super) fn figure(
    title: &str,
    (width, height): (u32, u32),
    draw: impl FnOnce(&Area<'_>) -> Result<(), PlotError>,
) -> Result<String, PlotError> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (width * FINE, height * FINE)).into_drawing_area();
        area.fill(&WHITE).map_err(failed)?;
        let area = area.margin(8 * FINE, 0, 0, 0);
        let area =
            if title.is_empty() { area } else { area.titled(title, ("sans-serif", 22 * FINE)).map_err(failed)? };
        draw(&area)?;
        area.present().map_err(failed)?;
    }
    let fine = format!("width=\"{}\" height=\"{}\"", width * FINE, height * FINE);
    Ok(svg.replacen(&fine, &format!("width=\"{width}\" height=\"{height}\""), 1))
}

/// Draws the legend of curves above the axes, where it covers no curve.
fn legend(area: &Area<'_>, entries: &[(u32, &str)], columns: usize) -> Result<(), PlotError> {
    for (k, &(id, label)) in entries.iter().enumerate() {
        let (x, y) = legend_place(k, columns);
        let ends = [(x, y), (x + 28 * FINE as i32, y)];
        match DASHES[id as usize / COLOURS.len() % DASHES.len()] {
            None => area.draw(&PathElement::new(ends, style(id))).map_err(failed)?,
            Some((on, off)) => {
                let line = DashedPathElement::new(ends, on * FINE, off * FINE, style(id));
                area.draw(&line).map_err(failed)?;
            }
        }
        legend_text(area, (x, y), label)?;
    }
    Ok(())
}

/// Position of the k-th entry of a legend.
fn legend_place(k: usize, columns: usize) -> (i32, i32) {
    let (width, size) = ((LEGEND_WIDTH / columns) as i32, |px: i32| px * FINE as i32);
    (size(84 + width * (k % columns) as i32), size(12 + 24 * (k / columns) as i32))
}

/// Draws the label of a legend entry, to the right of its line or marker.
pub(super) fn legend_text(area: &Area<'_>, (x, y): (i32, i32), label: &str) -> Result<(), PlotError> {
    let text = ("sans-serif", 15 * FINE).into_text_style(area).pos(Pos::new(HPos::Left, VPos::Center));
    area.draw(&Text::new(label.to_owned(), (x + 34 * FINE as i32, y), text)).map_err(failed)
}

/// Draws the curve of a mode.
fn curve(chart: &mut Chart<'_>, id: u32, points: Vec<(f64, f64)>) -> Result<(), PlotError> {
    match DASHES[id as usize / COLOURS.len() % DASHES.len()] {
        None => drop(chart.draw_series(LineSeries::new(points, style(id))).map_err(failed)?),
        Some((on, off)) => {
            let line = DashedLineSeries::new(points, on * FINE, off * FINE, style(id));
            chart.draw_series(line).map_err(failed)?;
        }
    }
    Ok(())
}

fn style(id: u32) -> ShapeStyle {
    COLOURS[id as usize % COLOURS.len()].stroke_width(2 * FINE)
}

/// Fill that marks windows of instability and squeal.
fn shade() -> ShapeStyle {
    RGBColor(213, 94, 0).mix(0.12).filled()
}

/// Number of columns of the legend of [`front`].
const FRONT_COLUMNS: usize = 5;

/// Error over run time of the routes to a prediction, on logarithmic axes: one curve per number of modes, one marker
/// per route at its median error. A line leads from there to the largest error.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn front(title: &str, routes: &[Route]) -> Result<String, PlotError> {
    // Errors of zero are drawn at the lower edge.
    let at = |route: &Route, error: f64| (route.median_us.log10(), error.max(1e-18).log10());
    let drawn: Vec<&Route> = routes.iter().filter(|route| route.median_error.is_finite()).collect();
    let mut curves: BTreeMap<usize, Vec<&Route>> = BTreeMap::new();
    let mut names: Vec<&str> = vec![];
    for route in &drawn {
        curves.entry(route.modes).or_default().push(route);
        if !names.contains(&route.route) {
            names.push(route.route);
        }
    }
    let mark = |name: &str| names.iter().position(|known| *known == name).unwrap_or(0);
    let x = decades(range(drawn.iter().map(|route| route.median_us.log10())));
    let errors =
        drawn.iter().flat_map(|route| [route.median_error, route.largest_error].map(|error| at(route, error).1));
    let y = decades(range(errors));
    figure(title, (1000, 640), |area| {
        let curve_names: Vec<String> = curves.keys().map(|modes| format!("{modes} modes")).collect();
        let entries: Vec<(u32, &str)> = (0..).zip(curve_names.iter().map(String::as_str)).collect();
        legend(area, &entries, FRONT_COLUMNS)?;
        let rows_of_curves = entries.len().div_ceil(FRONT_COLUMNS);
        for (k, name) in names.iter().enumerate() {
            let (x, y) = legend_place(FRONT_COLUMNS * rows_of_curves + k, FRONT_COLUMNS);
            area.draw(&marker(k, (x + 14 * FINE as i32, y), BLACK)).map_err(failed)?;
            legend_text(area, (x, y), name)?;
        }
        let area = &area.margin(24 * (rows_of_curves + names.len().div_ceil(FRONT_COLUMNS)) as u32 * FINE, 0, 0, 0);
        let labels = ("run time per condition, us", "relative error of the squared eigenvalue");
        let mut chart = axes_with_ticks(area, x, y, labels, (power_of_ten, power_of_ten))?;
        for (k, (_, mut curve)) in curves.into_iter().enumerate() {
            let colour = COLOURS[k % COLOURS.len()];
            curve.sort_by(|a, b| a.median_us.total_cmp(&b.median_us));
            let line = curve.iter().map(|route| at(route, route.median_error));
            chart.draw_series(LineSeries::new(line, colour.stroke_width(2 * FINE))).map_err(failed)?;
            for route in curve {
                let (median, largest) = (at(route, route.median_error), at(route, route.largest_error));
                let up = LineSeries::new([median, largest], colour.mix(0.5).stroke_width(FINE));
                chart.draw_series(up).map_err(failed)?;
                chart.draw_series([marker(mark(route.route), median, colour)]).map_err(failed)?;
            }
        }
        Ok(())
    })
}

/// The marker of the k-th route.
fn marker<'a, C: Clone + 'static>(k: usize, place: C, colour: RGBColor) -> DynElement<'static, SVGBackend<'a>, C> {
    let size = 5 * FINE;
    match k % 6 {
        0 => Circle::new(place, size, colour.filled()).into_dyn(),
        1 => TriangleMarker::new(place, size + FINE, colour.filled()).into_dyn(),
        2 => Cross::new(place, size, colour.stroke_width(2 * FINE)).into_dyn(),
        3 => Circle::new(place, size, colour.stroke_width(2 * FINE)).into_dyn(),
        4 => TriangleMarker::new(place, size + FINE, colour.stroke_width(2 * FINE)).into_dyn(),
        _ => Circle::new(place, size / 2, colour.filled()).into_dyn(),
    }
}

/// Errors of natural frequencies over the contact stiffness, as in the paper's Fig. 13: the mean and the largest error.
/// The range in which the rms error is below twice its minimum is shaded and the minimiser is marked.
/// `stiffness_n_per_m` corresponds to a factor of 1; if `None`, the axis shows the factor.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn identification(title: &str, found: &Identified, stiffness_n_per_m: Option<f64>) -> Result<String, PlotError> {
    let at = |factor: f64| (factor * stiffness_n_per_m.unwrap_or(1.0)).log10();
    // Errors of zero are drawn at the lower edge.
    let height = |error: f64| (100.0 * error).max(1e-12).log10();
    let finite = |trial: &&Trial| trial.rms_error.is_finite();
    let mut trials: Vec<&Trial> = found.curve.iter().chain([&found.best]).filter(finite).collect();
    trials.sort_by(|a, b| a.factor.total_cmp(&b.factor));
    let x = range(trials.iter().map(|trial| at(trial.factor)));
    let y = padded(range(trials.iter().flat_map(|trial| [height(trial.mean_error), height(trial.largest_error)])));
    let x_label = match stiffness_n_per_m {
        Some(_) => "contact stiffness of a pair, N/m",
        None => "contact stiffness relative to the rig's",
    };
    figure(title, (1000, 560), |area| {
        let labels = (x_label, "error of the frequencies, %");
        let mut chart = axes_with_ticks(area, x, y, labels, (logarithmic, logarithmic))?;
        let [from, to] = found.doubled;
        let (from, to) = (from.map_or(x.0, &at), to.map_or(x.1, &at));
        chart.draw_series([Rectangle::new([(from, y.0), (to, y.1)], shade())]).map_err(failed)?;
        // Drawn first: in front of the curves it would hide their minima.
        let best = at(found.best.factor);
        let marked = RGBColor(150, 150, 150).stroke_width(FINE);
        chart.draw_series(LineSeries::new([(best, y.0), (best, y.1)], marked)).map_err(failed)?;
        for (name, colour, side, of) in [
            ("mean", COLOURS[0], VPos::Top, (|trial| trial.mean_error) as fn(&Trial) -> f64),
            ("largest", COLOURS[1], VPos::Bottom, |trial| trial.largest_error),
        ] {
            let line: Vec<_> = trials.iter().map(|trial| (at(trial.factor), height(of(trial)))).collect();
            let position = Pos::new(HPos::Left, side);
            let text = ("sans-serif", 15 * FINE).into_text_style(area).pos(position).color(&colour);
            let away = if matches!(side, VPos::Top) { -0.015 } else { 0.015 } * (y.1 - y.0);
            let place = (line[0].0 + 0.01 * (x.1 - x.0), line[0].1 + away);
            chart.draw_series([Text::new(name, place, text)]).map_err(failed)?;
            chart.draw_series(LineSeries::new(line, colour.stroke_width(2 * FINE))).map_err(failed)?;
        }
        Ok(())
    })
}

/// Runs of consecutive bins for which `of` returns a value, as bin index and value.
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

type Tick = fn(f64, (f64, f64)) -> String;
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
pub(super) type Chart<'a> = ChartContext<'a, SVGBackend<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Axes with units, in the common style.
pub(super) fn axes<'a>(
    area: &Area<'a>,
    x: (f64, f64),
    y: (f64, f64),
    x_label: &str,
    y_label: &str,
) -> Result<Chart<'a>, PlotError> {
    axes_with_ticks(area, x, y, (x_label, y_label), (tick, tick))
}

/// The same axes, with functions that format ticks from the value and the range of the axis.
fn axes_with_ticks<'a>(
    area: &Area<'a>,
    x: (f64, f64),
    y: (f64, f64),
    (x_label, y_label): (&str, &str),
    (x_tick, y_tick): (Tick, Tick),
) -> Result<Chart<'a>, PlotError> {
    let mut chart = ChartBuilder::on(area)
        .margin(FINE * if x_label.is_empty() { 6 } else { 10 })
        .margin_right(30 * FINE)
        .x_label_area_size(FINE * if x_label.is_empty() { 24 } else { 44 })
        .y_label_area_size(84 * FINE)
        .build_cartesian_2d(x.0..x.1, y.0..y.1)
        .map_err(failed)?;
    chart
        .configure_mesh()
        .x_label_formatter(&|value| x_tick(*value, x))
        .y_label_formatter(&|value| y_tick(*value, y))
        .axis_style(BLACK.stroke_width(FINE))
        .set_all_tick_mark_size(5 * FINE)
        .light_line_style(TRANSPARENT)
        .bold_line_style(RGBColor(225, 225, 225).stroke_width(FINE))
        .x_desc(x_label)
        .y_desc(y_label)
        .y_labels(5)
        .label_style(("sans-serif", 15 * FINE))
        .axis_desc_style(("sans-serif", 17 * FINE))
        .draw()
        .map_err(failed)?;
    Ok(chart)
}

/// The label of a tick. A value that is zero up to rounding becomes 0.
fn tick(value: f64, (low, high): (f64, f64)) -> String {
    let value = if value.abs() < 1e-9 * (high - low) { 0.0 } else { value };
    FloatPrettyPrinter { allow_scientific: false, min_decimal: 1, max_decimal: 5 }.print(value)
}

/// The label of a tick on a logarithmic axis over many decades: only whole powers of ten.
fn power_of_ten(value: f64, _range: (f64, f64)) -> String {
    let digits = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let power = value.round();
    if (value - power).abs() > 1e-9 {
        return String::new();
    }
    let raised: String = power.abs().to_string().chars().filter_map(|c| digits.get(c.to_digit(10)? as usize)).collect();
    format!("10{}{raised}", if power < 0.0 { "⁻" } else { "" })
}

/// The label of a tick on a logarithmic axis over few decades: the value with two digits.
fn logarithmic(value: f64, _range: (f64, f64)) -> String {
    let value = 10f64.powf(value);
    let power = value.log10().floor();
    let rounded = format!("{:.1}", value / 10f64.powf(power));
    let (digits, power) = if rounded == "10.0" { ("1.0", power + 1.0) } else { (rounded.as_str(), power) };
    if (-3.0..4.0).contains(&power) {
        let decimals = (1.0 - power).max(0.0) as usize;
        let text = format!("{value:.decimals$}");
        return if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text };
    }
    let power = power_of_ten(power, (0.0, 0.0));
    match digits {
        "1.0" => power,
        _ => format!("{}·{power}", digits.trim_end_matches(".0")),
    }
}

/// The whole powers of ten that enclose a range of logarithms.
fn decades((low, high): (f64, f64)) -> (f64, f64) {
    ((low - 0.04 * (high - low)).floor(), (high + 0.04 * (high - low)).ceil())
}

/// Smallest and largest of `values`, widened if they are equal; `(0, 1)` if there are no values.
pub(super) fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    match (low < high, low.is_finite()) {
        (true, _) => (low, high),
        (false, true) => (low - 0.5, low + 0.5),
        (false, false) => (0.0, 1.0),
    }
}

pub(super) fn padded((low, high): (f64, f64)) -> (f64, f64) {
    let pad = 0.04 * (high - low);
    (low - pad, high + pad)
}

pub(super) fn failed(error: impl std::fmt::Display) -> PlotError {
    PlotError(error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_of_logarithmic_axes_are_values() {
        for (value, label) in [
            (0.0, "1"),
            (2.0, "100"),
            (-1.0, "0.1"),
            (-2.4, "0.004"),
            (1.5, "32"),
            (0.2, "1.6"),
            (3.0, "1000"),
            (6.0, "10⁶"),
            (7.2, "1.6·10⁷"),
            (6.9999, "10⁷"),
            (-5.0, "10⁻⁵"),
            (-5.5, "3.2·10⁻⁶"),
        ] {
            assert_eq!(logarithmic(value, (0.0, 1.0)), label, "10^{value}");
        }
    }
}
