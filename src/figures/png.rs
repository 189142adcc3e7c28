//! Pictures as PNG with a palette of 256 colours, and as data URIs.
//!
//! # Source
//! W3C, "Portable Network Graphics (PNG) Specification (Third Edition)", 2025.

use std::io::Write as _;

use flate2::Compression;
use flate2::write::ZlibEncoder;

/// Dark blue over red to light yellow, of evenly rising lightness: distinguishable with colour blindness and in print.
/// Stops of the palette: index and colour.
const STOPS: [(f64, [f64; 3]); 6] = [
    (0.0, [4.0, 5.0, 20.0]),
    (51.0, [48.0, 15.0, 98.0]),
    (102.0, [120.0, 28.0, 109.0]),
    (153.0, [188.0, 55.0, 84.0]),
    (204.0, [242.0, 125.0, 21.0]),
    (255.0, [252.0, 255.0, 164.0]),
];

/// Colour of each index of the palette.
pub fn colours() -> [[u8; 3]; 256] {
    std::array::from_fn(|index| {
        let at = index as f64;
        let upper = STOPS.iter().position(|stop| stop.0 >= at).unwrap_or(STOPS.len() - 1).max(1);
        let ((from, low), (to, high)) = (STOPS[upper - 1], STOPS[upper]);
        let share = (at - from) / (to - from);
        std::array::from_fn(|k| (low[k] + share * (high[k] - low[k])).round() as u8)
    })
}

/// A picture of indices into [`colours`], row by row from the top, as PNG. `pixels` has `width * height` entries.
pub fn png(width: u32, height: u32, pixels: &[u8]) -> Vec<u8> {
    assert_eq!(pixels.len(), width as usize * height as usize, "pixels of a picture");
    let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
    // 8 bits, a palette, and the only methods there are.
    chunk(&mut file, b"IHDR", &[&width.to_be_bytes()[..], &height.to_be_bytes(), &[8, 3, 0, 0, 0]].concat());
    chunk(&mut file, b"PLTE", colours().as_flattened());
    let mut rows = ZlibEncoder::new(vec![], Compression::default());
    for row in pixels.chunks(width.max(1) as usize) {
        // Filter 0: the bytes themselves. Writing to memory does not fail.
        let _ = rows.write_all(&[0]);
        let _ = rows.write_all(row);
    }
    chunk(&mut file, b"IDAT", &rows.finish().unwrap_or_default());
    chunk(&mut file, b"IEND", &[]);
    file
}

fn chunk(file: &mut Vec<u8>, kind: &[u8; 4], data: &[u8]) {
    file.extend((data.len() as u32).to_be_bytes());
    let start = file.len();
    file.extend(kind);
    file.extend(data);
    let sum = crc32fast::hash(&file[start..]);
    file.extend(sum.to_be_bytes());
}

/// A PNG file as a data URI.
pub fn data_uri(png: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut uri = "data:image/png;base64,".to_owned();
    for bytes in png.chunks(3) {
        let word = bytes.iter().fold(0_u32, |word, &byte| word << 8 | u32::from(byte)) << (8 * (3 - bytes.len()));
        for k in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * k)) as usize & 63];
            uri.push(if k > bytes.len() { '=' } else { char::from(digit) });
        }
    }
    uri
}

#[cfg(test)]
mod tests {
    use std::io::Read as _;

    use super::*;

    /// RFC 4648, section 10: test vectors.
    #[test]
    fn data_uris_are_base64() {
        for (bytes, expected) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(data_uri(bytes.as_bytes()), format!("data:image/png;base64,{expected}"));
        }
    }

    #[test]
    fn pictures_hold_their_pixels_and_light_rises_with_the_index() {
        let pixels: Vec<u8> = (0..=255).cycle().take(30 * 20).collect();
        let file = png(30, 20, &pixels);
        let at = file.windows(4).position(|kind| kind == b"IDAT").unwrap();
        let mut rows = vec![];
        flate2::read::ZlibDecoder::new(&file[at + 4..]).read_to_end(&mut rows).unwrap();
        let read: Vec<u8> = rows.chunks(31).flat_map(|row| row[1..].to_vec()).collect();
        assert_eq!(read, pixels);
        let light = colours().map(|[r, g, b]| 0.2126 * f64::from(r) + 0.7152 * f64::from(g) + 0.0722 * f64::from(b));
        assert!(light.is_sorted() && light[255] > 240.0 && light[0] < 10.0);
    }
}
