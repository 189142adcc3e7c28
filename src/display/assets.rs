//! The files of the page, inside the program.
//!
//! `vendor/` holds uPlot 1.6.32 and three.js 0.184.0 as their npm packages ship them, with their licences.

use std::sync::OnceLock;

/// A file of the page.
pub struct Asset {
    pub path: &'static str,
    pub media_type: &'static str,
    pub bytes: &'static [u8],
    compressed: OnceLock<Vec<u8>>,
}

impl Asset {
    const fn new(path: &'static str, media_type: &'static str, bytes: &'static [u8]) -> Self {
        Self { path, media_type, bytes, compressed: OnceLock::new() }
    }

    /// Its zstd form, made when it is first asked for.
    pub fn compressed(&self) -> &[u8] {
        self.compressed.get_or_init(|| zstd::bulk::compress(self.bytes, 9).unwrap_or_else(|_| self.bytes.to_vec()))
    }
}

macro_rules! assets {
    ($($path:literal: $media_type:expr),* $(,)?) => {
        [$(Asset::new($path, $media_type, include_bytes!(concat!("assets/", $path)))),*]
    };
}

const JS: &str = "text/javascript; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";

/// Every file of the page; the first is the page itself.
pub static ASSETS: [Asset; 20] = assets! {
    "index.html": "text/html; charset=utf-8",
    "style.css": CSS,
    "icon.svg": "image/svg+xml",
    "theme.js": JS,
    "app.js": JS,
    "clock.js": JS,
    "events.js": JS,
    "format.js": JS,
    "history.js": JS,
    "map.js": JS,
    "modes.js": JS,
    "shape.js": JS,
    "status.js": JS,
    "timeline.js": JS,
    "vendor/three.core.min.js": JS,
    "vendor/three.module.min.js": JS,
    "vendor/three.LICENSE": TEXT,
    "vendor/uplot.iife.min.js": JS,
    "vendor/uplot.css": CSS,
    "vendor/uplot.LICENSE": TEXT,
};

/// The file at a path below the root; the root is the page.
pub fn find(path: &str) -> Option<&'static Asset> {
    let path = if path.is_empty() { "index.html" } else { path };
    ASSETS.iter().find(|asset| asset.path == path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_small_and_whole() {
        let compressed: usize = ASSETS.iter().map(|asset| asset.compressed().len()).sum();
        assert!(compressed < 1_000_000, "{compressed} bytes compressed");
        for asset in &ASSETS {
            assert_eq!(zstd::bulk::decompress(asset.compressed(), 10_000_000).unwrap(), asset.bytes, "{}", asset.path);
        }
        assert!(find("").is_some_and(|asset| asset.bytes.starts_with(b"<!doctype html>")));
        assert!(find("../Cargo.toml").is_none());
    }

    /// The page may not name another origin: licences and namespaces aside, no address in it.
    #[test]
    fn the_page_asks_nobody_else() {
        for asset in ASSETS.iter().filter(|asset| !asset.path.starts_with("vendor/")) {
            let text = String::from_utf8_lossy(asset.bytes).replace("http://www.w3.org/2000/svg", "");
            assert!(!text.contains("http:") && !text.contains("https:"), "{}", asset.path);
            assert!(!text.contains(" style=\"") && !text.contains("<style"), "{}: inline style", asset.path);
        }
    }
}
