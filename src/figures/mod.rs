//! Figures as SVG and self-contained HTML pages.

pub mod html;
pub mod plane;
pub mod plot;
