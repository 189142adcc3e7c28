//! Figures of a study: a column of its table over another, or over two.

use std::path::Path;

use super::merge::table_of;
use super::table::{Kind, Table};
use super::{StudyError, TableError};
use crate::figures::scatter::{Labels, draw};

/// Draws column `y` over column `x` of a table or of the folder of a study, with `colour` as colours. Cases that lack one of the
/// values are counted below the title.
///
/// # Errors
/// [`StudyError`]: there is no such column of numbers, or no case with all values.
pub fn figure(path: &Path, x: &str, y: &str, colour: Option<&str>) -> Result<String, StudyError> {
    let names: Vec<&str> = [x, y].into_iter().chain(colour).collect();
    let (table, columns) = table_of(path, &names)?;
    let file = path.display().to_string();
    let column = |name: &str| {
        numbers(&table, name).ok_or_else(|| {
            let drawn = columns.iter().filter(|column| matches!(column.kind, Kind::Whole | Kind::Number));
            let columns = drawn.map(|column| column.name.as_str()).collect::<Vec<_>>().join(", ");
            StudyError::NoColumn { file: file.clone(), column: name.to_owned(), columns }
        })
    };
    let (xs, ys) = (column(x)?, column(y)?);
    let colours = colour.map(column).transpose()?;
    if xs.len() != ys.len() {
        let reason = "columns differ in length".to_owned();
        return Err(TableError::Unreadable { file, reason }.into());
    }
    let mut points = vec![];
    for (row, (x, y)) in xs.iter().zip(&ys).enumerate() {
        let shade = match &colours {
            None => Some(None),
            Some(colours) => colours.get(row).copied().flatten().filter(|value| value.is_finite()).map(Some),
        };
        if let (Some(x), Some(y), Some(shade)) = (x, y, shade)
            && x.is_finite()
            && y.is_finite()
        {
            points.push((*x, *y, shade));
        }
    }
    if points.is_empty() {
        return Err(StudyError::NothingToDraw { file, columns: names.join(", ") });
    }
    let without = xs.len() - points.len();
    let title = match without {
        0 => format!("{} cases", points.len()),
        _ => format!("{} cases, {without} more without a value", points.len()),
    };
    Ok(draw(&title, Labels { x, y, colour }, &points)?)
}

fn numbers(table: &Table, name: &str) -> Option<Vec<Option<f64>>> {
    table.column(name)?.numbers()
}
