//! Spectrograms with predicted frequencies and squeals over them.

use plotters::prelude::*;

use super::plot::{Area, Chart, FINE, PlotError, axes, failed, figure};
use super::png::{data_uri, png};
use crate::sound::spectrogram::{STEP_DB, Spectrogram};

/// Levels from the highest down that are told apart by colour, dB.
const RANGE_DB: f64 = 80.0;
/// Fill of the rectangle whose place the picture takes.
const PLACE: RGBColor = RGBColor(1, 2, 3);
/// Colour of predicted frequencies over the picture.
const PREDICTED: RGBColor = RGBColor(64, 224, 255);

/// What is drawn over a spectrogram; times in s after its beginning.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Overlay {
    /// Stretches of time and frequencies of modes predicted to be unstable in them: from, to, Hz.
    pub predicted: Vec<(f64, f64, f64)>,
    /// Squeals found in the sound: onset, end, Hz.
    pub squeals: Vec<(f64, f64, f64)>,
}

/// Colours of a spectrogram as indices of the palette, row by row from the highest frequency down, a pixel for each cell:
/// [`highest`] is 255, and 80 dB below it is 0. Times without samples are 0. Returns width, height and pixels.
pub fn pixels(spectrogram: &Spectrogram, highest: u8) -> (u32, u32, Vec<u8>) {
    let columns = spectrogram.columns();
    let Some(first) = columns.front() else { return (0, 0, vec![]) };
    let (width, rows) = (spectrogram.span() as usize, spectrogram.rows());
    let colour = |cell: u8| {
        let below_db = STEP_DB * f64::from(highest.saturating_sub(cell));
        (255.0 * (1.0 - below_db / RANGE_DB)).round() as u8
    };
    let mut pixels = vec![0; width * rows];
    for column in columns {
        let x = (column.index - first.index) as usize;
        for (row, &cell) in column.cells.iter().enumerate().filter(|(_, cell)| **cell > 0) {
            pixels[(rows - 1 - row) * width + x] = colour(cell);
        }
    }
    (width as u32, rows as u32, pixels)
}

/// The largest cell of a spectrogram.
pub fn highest(spectrogram: &Spectrogram) -> u8 {
    spectrogram.columns().iter().flat_map(|column| &column.cells).max().copied().unwrap_or(0)
}

/// A spectrogram as a picture in a figure, from `from_s` after the epoch on, with the level of the band below it. A line
/// marks `threshold_db`.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn spectrogram(
    spectrogram: &Spectrogram,
    overlay: &Overlay,
    from_s: f64,
    threshold_db: f64,
) -> Result<String, PlotError> {
    let (width, height, pixels) = pixels(spectrogram, highest(spectrogram));
    let column_s = spectrogram.column_ns() as f64 * 1e-9;
    let at = |index: i64| index as f64 * column_s - from_s;
    let first = spectrogram.columns().front().map_or(0, |column| column.index);
    let time = (at(first), at(first + i64::from(width.max(1))));
    let svg = figure("", (1000, 640), |area| {
        let (upper, lower) = area.split_vertically(68.percent());
        let y = (spectrogram.bottom_hz(), spectrogram.top_hz());
        let mut chart = axes(&upper, time, y, "time, s", "frequency, Hz")?;
        let place = Rectangle::new([(time.0, y.0), (time.1, y.1)], PLACE.filled());
        chart.draw_series([place]).map_err(failed)?;
        overlay_lines(&mut chart, overlay, time)?;
        level(&lower, spectrogram, time, from_s, threshold_db)
    })?;
    Ok(with_picture(&svg, &data_uri(&png(width, height, &pixels))))
}

/// Predicted frequencies as lines, squeals as frames around them.
fn overlay_lines(chart: &mut Chart<'_>, overlay: &Overlay, time: (f64, f64)) -> Result<(), PlotError> {
    let clipped = |&(from, to, hz): &(f64, f64, f64)| {
        let (from, to) = (from.max(time.0), to.min(time.1));
        (from < to).then_some((from, to, hz))
    };
    for (from, to, hz) in overlay.predicted.iter().filter_map(clipped) {
        chart
            .draw_series(LineSeries::new([(from, hz), (to, hz)], PREDICTED.stroke_width(3 * FINE / 2)))
            .map_err(failed)?;
    }
    for (from, to, hz) in overlay.squeals.iter().filter_map(clipped) {
        let frame = Rectangle::new([(from, (hz - 250.0).max(0.0)), (to, hz + 250.0)], WHITE.stroke_width(2 * FINE));
        chart.draw_series([frame]).map_err(failed)?;
    }
    Ok(())
}

/// The level of the band over time.
fn level(
    area: &Area<'_>,
    spectrogram: &Spectrogram,
    time: (f64, f64),
    from_s: f64,
    threshold_db: f64,
) -> Result<(), PlotError> {
    let column_s = spectrogram.column_ns() as f64 * 1e-9;
    let levels: Vec<(f64, f64)> = spectrogram
        .columns()
        .iter()
        .filter(|column| column.level_db.is_finite())
        .map(|column| ((column.index as f64 + 0.5) * column_s - from_s, f64::from(column.level_db)))
        .collect();
    let low = levels.iter().map(|level| level.1).fold(threshold_db, f64::min) - 5.0;
    let high = levels.iter().map(|level| level.1).fold(threshold_db, f64::max) + 5.0;
    let mut chart = axes(area, time, (low, high), "time, s", "band level, dB")?;
    for stretch in levels.chunk_by(|a, b| b.0 - a.0 < 1.5 * column_s) {
        let line = LineSeries::new(stretch.iter().copied(), RGBColor(26, 53, 216).stroke_width(FINE));
        chart.draw_series(line).map_err(failed)?;
    }
    let line = LineSeries::new([(time.0, threshold_db), (time.1, threshold_db)], BLACK.mix(0.5).stroke_width(FINE));
    chart.draw_series(line).map_err(failed)?;
    Ok(())
}

/// Replaces the rectangle that marks its place by a picture.
fn with_picture(svg: &str, uri: &str) -> String {
    let Some(fill) = svg.find("fill=\"#010203\"") else { return svg.to_owned() };
    let start = svg[..fill].rfind("<rect").unwrap_or(fill);
    let end = svg[fill..].find("/>").map_or(svg.len(), |end| fill + end + 2);
    let value = |name: &str| {
        let rect = &svg[start..end];
        let from = rect.find(&format!(" {name}=\"")).map_or(0, |at| at + name.len() + 3);
        rect[from..].split('"').next().unwrap_or_default()
    };
    let [x, y, width, height] = ["x", "y", "width", "height"].map(value);
    format!(
        "{}<image x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" preserveAspectRatio=\"none\" \
         style=\"image-rendering:pixelated\" href=\"{uri}\"/>{}",
        &svg[..start],
        &svg[end..]
    )
}

/// Squeals as points over three conditions side by side: frequency, and the conditions in `panels` with their values for
/// each squeal, against the level.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn scatter(panels: &[Scatter<'_>]) -> Result<String, PlotError> {
    figure("", (1000, 300 * panels.len().div_ceil(2).max(1) as u32), |area| {
        let areas = area.split_evenly((panels.len().div_ceil(2).max(1), 2));
        for (area, panel) in areas.iter().zip(panels) {
            let [x, y] = [0, 1].map(|axis| {
                let values =
                    panel.points.iter().map(|point| [point.0, point.1][axis]).filter(|value| value.is_finite());
                let values =
                    values.chain(panel.line.then(|| panel.points.iter().map(|p| p.0.max(p.1)).fold(0.0, f64::max)));
                let (low, high) =
                    values.fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
                let room = (0.05 * (high - low)).max(0.02 * high.abs()).max(1e-6);
                if low > high { (0.0, 1.0) } else { (low - room, high + room) }
            });
            let mut chart = axes(area, x, y, panel.x_label, panel.y_label)?;
            if panel.line {
                let (from, to) = (x.0.max(y.0), x.1.min(y.1));
                let line = LineSeries::new([(from, from), (to, to)], BLACK.mix(0.4).stroke_width(FINE));
                chart.draw_series(line).map_err(failed)?;
            }
            let finite = panel.points.iter().filter(|point| point.0.is_finite() && point.1.is_finite());
            let dot = |&(x, y): &(f64, f64)| Circle::new((x, y), 3 * FINE, RGBColor(26, 53, 216).mix(0.6).filled());
            chart.draw_series(finite.map(dot)).map_err(failed)?;
        }
        Ok(())
    })
}

/// A panel of [`scatter`].
pub struct Scatter<'a> {
    pub x_label: &'a str,
    pub y_label: &'a str,
    pub points: Vec<(f64, f64)>,
    /// Whether equal values are marked by a line.
    pub line: bool,
}
