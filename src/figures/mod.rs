//! Figures as SVG and self-contained HTML pages.

pub mod contact;
pub mod html;
pub mod plane;
pub mod plot;
pub mod png;
pub mod scatter;
pub mod spectrogram;
