//! Figures of points over two numbers, coloured by a third: circles, or cells that fill the plane where the points are a grid.

use plotters::prelude::*;

use super::plane::{CLASSES, colour};
use super::plot::{COLOURS, FINE, PlotError, axes, failed, figure, legend_text, padded, range};

/// The labels of a figure.
#[derive(Clone, Copy, Debug)]
pub struct Labels<'a> {
    pub x: &'a str,
    pub y: &'a str,
    /// Of the third number.
    pub colour: Option<&'a str>,
}

/// A point with the number that its colour shows.
pub type Dot = (f64, f64, Option<f64>);

/// Draws points.
///
/// # Errors
/// [`PlotError`] if the plotting library fails.
pub fn draw(title: &str, labels: Labels<'_>, dots: &[Dot]) -> Result<String, PlotError> {
    let shades = range(dots.iter().filter_map(|(_, _, shade)| *shade));
    let class = |shade: f64| {
        let share = (shade - shades.0) / (shades.1 - shades.0);
        ((share * CLASSES as f64) as usize).min(CLASSES - 1)
    };
    let fill = |shade: Option<f64>| shade.map_or(COLOURS[0], |shade| colour(class(shade)));
    let rows = if labels.colour.is_some() { 2 } else { 0 };
    figure(title, (1000, 620 + 26 * rows), |area| {
        let (head, area) = area.split_vertically(26 * rows * FINE);
        if let Some(name) = labels.colour {
            legend_text(&head, (56 * FINE as i32, 12 * FINE as i32), name)?;
            for k in 0..CLASSES {
                let end = |k: usize| shades.0 + (shades.1 - shades.0) * k as f64 / CLASSES as f64;
                let (x, y) = ((84 + 140 * k as i32) * FINE as i32, 38 * FINE as i32);
                let half = 8 * FINE as i32;
                let corners = [(x + 10 * FINE as i32, y - half), (x + 26 * FINE as i32, y + half)];
                head.draw(&Rectangle::new(corners, colour(k).filled())).map_err(failed)?;
                legend_text(&head, (x, y), &format!("to {}", crate::text::number::significant(end(k + 1), 3)))?;
            }
        }
        match grid(dots).filter(|_| labels.colour.is_some()) {
            Some([columns, lines]) => {
                let ends = |edges: &[f64]| (edges[0], edges[edges.len() - 1]);
                let (columns, lines) = (edges(&columns), edges(&lines));
                let mut chart = axes(&area, ends(&columns), ends(&lines), labels.x, labels.y)?;
                let cells = dots.iter().map(|&(x, y, shade)| {
                    let [(left, right), (low, high)] = [around(&columns, x), around(&lines, y)];
                    Rectangle::new([(left, low), (right, high)], fill(shade).filled())
                });
                chart.draw_series(cells).map_err(failed)?;
            }
            None => {
                let (x, y) = (range(dots.iter().map(|dot| dot.0)), range(dots.iter().map(|dot| dot.1)));
                let mut chart = axes(&area, padded(x), padded(y), labels.x, labels.y)?;
                let circles = dots.iter().map(|&(x, y, shade)| Circle::new((x, y), 5 * FINE / 2, fill(shade).filled()));
                chart.draw_series(circles).map_err(failed)?;
            }
        }
        Ok(())
    })
}

/// The coordinates of a grid that the points fill: each place of it holds one point.
fn grid(dots: &[Dot]) -> Option<[Vec<f64>; 2]> {
    let distinct = |value: fn(&Dot) -> f64| {
        let mut values: Vec<f64> = dots.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values.dedup();
        values
    };
    let [columns, lines] = [distinct(|dot| dot.0), distinct(|dot| dot.1)];
    let mut places: Vec<(u64, u64)> = dots.iter().map(|dot| (dot.0.to_bits(), dot.1.to_bits())).collect();
    places.sort_unstable();
    places.dedup();
    let full = columns.len() * lines.len() == dots.len() && places.len() == dots.len();
    (full && columns.len() > 1 && lines.len() > 1).then_some([columns, lines])
}

/// The edges of cells around ascending values.
fn edges(values: &[f64]) -> Vec<f64> {
    let (first, second) = (values[0], values[1]);
    let (before, last) = (values[values.len() - 2], values[values.len() - 1]);
    let mut edges = vec![first - 0.5 * (second - first)];
    edges.extend(values.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])));
    edges.push(last + 0.5 * (last - before));
    edges
}

/// The edges of the cell that holds a value.
fn around(edges: &[f64], value: f64) -> (f64, f64) {
    let after = edges.partition_point(|edge| *edge <= value).clamp(1, edges.len() - 1);
    (edges[after - 1], edges[after])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_a_grid_become_cells_and_others_circles() {
        let labels = Labels { x: "load, N", y: "speed", colour: Some("growth") };
        let full: Vec<Dot> = (0..6).map(|k| (f64::from(k % 3), f64::from(k / 3), Some(f64::from(k)))).collect();
        assert_eq!(grid(&full), Some([vec![0.0, 1.0, 2.0], vec![0.0, 1.0]]));
        assert_eq!((grid(&full[1..]), grid(&full[..3])), (None, None));
        let counted = |dots: &[Dot], labels| draw("a title", labels, dots).unwrap().matches("<circle").count();
        assert_eq!(counted(&full, labels), 0);
        assert_eq!(counted(&full[1..], labels), 5);
        assert_eq!(counted(&full, Labels { colour: None, ..labels }), 6);
        assert_eq!(counted(&[(1.0, 2.0, None)], Labels { colour: None, ..labels }), 1);
        assert_eq!(edges(&[1.0, 2.0, 4.0]), [0.5, 1.5, 3.0, 5.0]);
        assert_eq!([around(&[0.5, 1.5, 3.0], 1.0), around(&[0.5, 1.5, 3.0], 2.0)], [(0.5, 1.5), (1.5, 3.0)]);
    }
}
