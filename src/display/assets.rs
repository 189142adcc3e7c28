//! The files of the page, embedded in the program.
//!
//! `vendor/` contains uPlot 1.6.32 and three.js 0.184.0 as published on npm, with their licences.

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

    /// The file compressed with zstd, on first use.
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

/// All files of the page; the first is the page itself.
pub static ASSETS: [Asset; 22] = assets! {
    "index.html": "text/html; charset=utf-8",
    "style.css": CSS,
    "icon.svg": "image/svg+xml",
    "theme.js": JS,
    "app.js": JS,
    "clock.js": JS,
    "contact.js": JS,
    "events.js": JS,
    "format.js": JS,
    "history.js": JS,
    "map.js": JS,
    "modes.js": JS,
    "shape.js": JS,
    "sound.js": JS,
    "status.js": JS,
    "timeline.js": JS,
    "vendor/three.core.min.js": JS,
    "vendor/three.module.min.js": JS,
    "vendor/three.LICENSE": TEXT,
    "vendor/uplot.iife.min.js": JS,
    "vendor/uplot.css": CSS,
    "vendor/uplot.LICENSE": TEXT,
};

/// The file at a path below the root; an empty path is the page.
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

    /// The page must not refer to another origin: apart from licences and namespaces it contains no addresses.
    #[test]
    fn the_page_requests_no_other_origin() {
        for asset in ASSETS.iter().filter(|asset| !asset.path.starts_with("vendor/")) {
            let text = String::from_utf8_lossy(asset.bytes).replace("http://www.w3.org/2000/svg", "");
            assert!(!text.contains("http:") && !text.contains("https:"), "{}", asset.path);
            assert!(!text.contains(" style=\"") && !text.contains("<style"), "{}: inline style", asset.path);
        }
    }

    type Rgb = [f64; 3];

    /// Linear RGB as seen with one kind of cone missing: Machado, Oliveira and Fernandes (2009), severity 1.
    const SEEN: [(&str, [Rgb; 3]); 4] = [
        ("no deficiency", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        (
            "deuteranopia",
            [[0.367_322, 0.860_646, -0.227_968], [0.280_085, 0.672_501, 0.047_413], [-0.011_820, 0.042_940, 0.968_881]],
        ),
        (
            "protanopia",
            [
                [0.152_286, 1.052_583, -0.204_868],
                [0.114_503, 0.786_281, 0.099_216],
                [-0.003_882, -0.048_116, 1.051_998],
            ],
        ),
        (
            "tritanopia",
            [
                [1.255_528, -0.076_749, -0.178_779],
                [-0.078_411, 0.930_809, 0.147_602],
                [0.004_733, 0.691_367, 0.303_900],
            ],
        ),
    ];

    fn times(matrix: [Rgb; 3], v: Rgb) -> Rgb {
        matrix.map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum())
    }

    fn linear(rgb: [u8; 3]) -> Rgb {
        rgb.map(|value| match f64::from(value) / 255.0 {
            dark if dark <= 0.04045 => dark / 12.92,
            value => ((value + 0.055) / 1.055).powf(2.4),
        })
    }

    /// OKLab (Ottosson 2020): a just noticeable difference is about 0.02.
    fn oklab(linear: Rgb) -> Rgb {
        let cones = times(
            [
                [0.412_221_470_8, 0.536_332_536_3, 0.051_445_992_9],
                [0.211_903_498_2, 0.680_699_545_1, 0.107_396_956_6],
                [0.088_302_461_9, 0.281_718_837_6, 0.629_978_700_5],
            ],
            linear.map(|value| value.clamp(0.0, 1.0)),
        );
        times(
            [
                [0.210_454_255_3, 0.793_617_785_0, -0.004_072_046_8],
                [1.977_998_495_1, -2.428_592_205_0, 0.450_593_709_9],
                [0.025_904_037_1, 0.782_771_766_2, -0.808_675_766_0],
            ],
            cones.map(f64::cbrt),
        )
    }

    fn distance(a: Rgb, b: Rgb) -> f64 {
        a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
    }

    /// Contrast ratio of WCAG 2.2, which requires 3 for lines of a figure.
    fn contrast(a: Rgb, b: Rgb) -> f64 {
        let luminance = |rgb: Rgb| 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];
        let (a, b) = (luminance(a) + 0.05, luminance(b) + 0.05);
        a.max(b) / a.min(b)
    }

    /// Every value of a colour in the style sheet, in order: light theme, dark theme, dark theme again.
    fn colours(name: &str) -> Vec<[u8; 3]> {
        let css = std::str::from_utf8(find("style.css").unwrap().bytes).unwrap();
        let hex = |text: &str| {
            // `#fff` is short for `#ffffff`.
            let digits: Vec<u8> = text.bytes().take_while(u8::is_ascii_hexdigit).collect();
            let digit = |k: usize| char::from(digits[k * digits.len() / 6]).to_digit(16).unwrap() as u8;
            [0, 1, 2].map(|k| 16 * digit(2 * k) + digit(2 * k + 1))
        };
        let values: Vec<[u8; 3]> = css.split(&format!("{name}: #")).skip(1).map(hex).collect();
        assert_eq!(values.len(), 3, "{name}");
        assert_eq!(values[1], values[2], "{name} of the dark theme");
        values
    }

    #[test]
    fn colours_of_modes_differ_for_colour_blind_people() {
        let panel = colours("--panel");
        let modes: Vec<Vec<[u8; 3]>> = (0..7).map(|k| colours(&format!("--mode-{k}"))).collect();
        for theme in 0..2 {
            for (name, matrix) in SEEN {
                let seen: Vec<Rgb> = modes.iter().map(|mode| oklab(times(matrix, linear(mode[theme])))).collect();
                for (a, b) in (0..7).flat_map(|a| (0..a).map(move |b| (a, b))) {
                    let apart = distance(seen[a], seen[b]);
                    assert!(apart > 0.12, "{name}, theme {theme}: modes {b} and {a} are {apart:.3} apart");
                }
            }
            for (k, mode) in modes.iter().enumerate() {
                let against = contrast(linear(mode[theme]), linear(panel[theme]));
                assert!(against >= 3.0, "theme {theme}: mode {k} has a contrast of {against:.2} against the panel");
            }
        }
        for (mode, drawn) in modes.iter().zip(crate::figures::plot::COLOURS) {
            assert_eq!(mode[0], [drawn.0, drawn.1, drawn.2], "figures have the colours of the page");
        }
    }

    #[test]
    fn growth_rates_are_coloured_from_faint_to_strong_on_either_panel() {
        let panel = colours("--panel");
        let stops: Vec<Vec<[u8; 3]>> = (0..4).map(|k| colours(&format!("--heat-{k}"))).collect();
        for theme in 0..2 {
            let against: Vec<f64> =
                stops.iter().map(|stop| contrast(linear(stop[theme]), linear(panel[theme]))).collect();
            assert!(against[0] >= 3.0 && against.is_sorted(), "theme {theme}: contrasts {against:?}");
        }
    }
}
