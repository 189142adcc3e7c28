//! Reproduces the paper's tables and figures: data, figures and a page that shows them with the paper's numbers.

mod nine_dof;
mod tribometer;

use crate::export::ExportError;
use crate::figures::html::{figure, page, section};
use crate::figures::plot::PlotError;
use crate::physics::identification::IdentificationError;
use crate::physics::{MapError, ModelError, SolveError};
use crate::reduction::{CompareError, ReductionError};
use crate::rig::RigError;

pub use nine_dof::nine_dof;
pub use tribometer::{MODES, PartModes, Step, Study};

/// A reproduced table or figure of the paper.
#[derive(Clone, Debug)]
pub struct Item {
    /// Base name of its files.
    pub name: &'static str,
    /// Its title, such as `Table 1: …`.
    pub title: String,
    /// Explanation, as HTML.
    pub text: String,
    /// The data as CSV.
    pub csv: String,
    /// The figure as SVG; `None` for a table.
    pub svg: Option<String>,
}

/// Why a table or figure was not reproduced.
#[derive(Debug, thiserror::Error)]
pub enum ReproduceError {
    #[error(transparent)]
    Rig(Box<RigError>),
    #[error(transparent)]
    Export(#[from] ExportError),
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error(transparent)]
    Solve(#[from] SolveError),
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    FullModel(#[from] ReductionError),
    #[error(transparent)]
    Windows(#[from] CompareError),
    #[error(transparent)]
    Identification(#[from] IdentificationError<ReductionError>),
    #[error(transparent)]
    Plot(#[from] PlotError),
    #[error("{full_model}: has no `band.max_hz`, which limits the frequencies compared")]
    NoBand { full_model: String },
    #[error("{model}: {found} natural frequencies at rest, expected {expected}")]
    Frequencies { model: String, found: usize, expected: usize },
    #[error("{file}: cannot select the modes of pad and disc: {reason}")]
    Modes { file: String, reason: String },
    #[error("{model}")]
    Reduced { model: String, source: Box<ReproduceError> },
}

impl From<RigError> for ReproduceError {
    fn from(error: RigError) -> Self {
        Self::Rig(error.into())
    }
}

/// A page with all items, as HTML.
pub fn index(items: &[Item]) -> String {
    let mut body = "<h1>The paper's tables and figures, reproduced</h1>\n\
         <p class=\"lead\">Every number is computed; the paper's own are given next to them. Each table and figure is also a \
         file in the folder of this page.</p>\n"
        .to_owned();
    let entry = |item: &Item| format!("<li><a href=\"#{}\">{}</a></li>\n", item.name, item.title);
    body +=
        &format!("<nav aria-label=\"Contents\">\n<ul>\n{}</ul>\n</nav>\n", items.iter().map(entry).collect::<String>());
    for item in items {
        let drawn = match &item.svg {
            Some(svg) => figure(svg, &item.text),
            None => item.text.clone(),
        };
        body += &format!("<div id=\"{}\">\n{}</div>\n", item.name, section(&item.title, &drawn));
    }
    page("squealcast: the paper's tables and figures", &body)
}

/// An HTML table of text cells.
fn table(header: &[&str], rows: &[Vec<String>]) -> String {
    let row = |cells: &mut dyn Iterator<Item = String>| format!("<tr>{}</tr>\n", cells.collect::<String>());
    let head = row(&mut header.iter().map(|cell| format!("<th scope=\"col\">{cell}</th>")));
    let body: String = rows.iter().map(|cells| row(&mut cells.iter().map(|cell| format!("<td>{cell}</td>")))).collect();
    format!("<table>\n<thead>\n{head}</thead>\n<tbody>\n{body}</tbody>\n</table>\n")
}
