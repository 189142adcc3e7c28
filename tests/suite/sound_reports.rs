//! Scores of many recordings, and the part of a report on sound.

use std::io::Read as _;
use std::path::Path;

use crate::program::{json, number, run, text};
use crate::sound_beside_logs::{Simulated, simulated};
use serde_json::Value;

/// Predicts the log of a simulated session with its sound into `folder/out`, and without into `folder/out`, too.
fn with_and_without_sound(simulated: &Simulated) -> String {
    let out = text(&simulated.folder.path().join("out"));
    let args = ["predict-log", &simulated.log, "--rig", "tribometer", "-o", &out];
    run(args.iter().chain(&["--sound", &simulated.sound, "--unit", "Pa"])).exits(0);
    // Names of recordings have their second.
    std::thread::sleep(std::time::Duration::from_millis(1100));
    run(args).exits(0);
    out
}

/// The scores are those of `hear --against`, which reads the sound itself; sums are sums of counts.
#[test]
fn one_table_scores_many_recordings_with_the_counts_of_every_score() {
    let simulated = simulated();
    let out = with_and_without_sound(&simulated);
    let table = json(["score", &out, &out, "--json"]);
    let rows = table["rows"].as_array().expect("rows");
    assert_eq!((rows.len(), table["without_sound"].as_array().expect("names").len()), (2, 2), "{table}");
    let recording = rows[0]["recording"].as_str().expect("a name");
    let hear = json(["hear", &simulated.sound, "--unit", "Pa", "--against", recording, "--json"]);
    let against = &hear["channels"][0]["against"];
    for (ours, theirs) in
        [("hits", "hits"), ("misses", "misses"), ("confirmed", "confirmed"), ("false_alarms", "false_alarms")]
    {
        assert_eq!(rows[0][ours], against["score"][theirs], "{ours}");
    }
    for (ours, theirs) in [("slots_hit", "hits"), ("slots_missed", "misses"), ("slots_quiet", "quiet")] {
        assert_eq!(rows[0][ours], against["slots"][theirs], "{ours}");
    }
    for score in ["recall", "precision", "mcc"] {
        assert_eq!(rows[0][score], against[score], "{score}");
    }
    assert!(number(&rows[0], "hits") >= 1.0 && number(&rows[0], "least_lead_s") > 0.0, "{table}");
    for count in ["hits", "misses", "confirmed", "false_alarms", "slots_hit", "slots_quiet", "judged_s"] {
        assert_eq!(number(&table["total"], count), 2.0 * number(&rows[0], count), "{count}");
    }
    assert_eq!(table["total"]["recall"], rows[0]["recall"]);

    let csv = text(&simulated.folder.path().join("scores.csv"));
    let shown = run(["score", &out, "--csv", &csv]).exits(0);
    assert!(shown.stdout.contains("hits") && shown.stdout.contains(recording), "{}", shown.stdout);
    assert!(shown.stderr.contains("holds no sound in the time of its predictions"), "{}", shown.stderr);
    let lines = std::fs::read_to_string(&csv).expect("the table");
    assert!(lines.starts_with("recording,channel,judged_s,hits,misses,") && lines.lines().count() == 2, "{lines}");
    let other = json(["score", &out, "--channel", "2", "--json"]);
    assert!(other["rows"].as_array().expect("rows").is_empty() && other["total"]["recall"].is_null(), "{other}");
}

/// The bytes of a base64 text.
fn decoded(base64: &str) -> Vec<u8> {
    let digit = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let digits: Vec<u8> = base64.bytes().filter(|&c| c != b'=').map(digit).collect();
    let word = |four: &[u8]| {
        let bits = four.iter().fold(0_u32, |word, &digit| word << 6 | u32::from(digit)) << (6 * (4 - four.len()));
        bits.to_be_bytes()[1..four.len()].to_vec()
    };
    digits.chunks(4).flat_map(word).collect()
}

/// The picture of a report: its place in the figure (x, y, width, height in drawing units), and its rows of pixels.
struct Picture {
    place: [f64; 4],
    width: usize,
    rows: Vec<Vec<u8>>,
}

fn picture(html: &str) -> Picture {
    let from = html.find("<image").expect("a picture");
    let image = &html[from..];
    let value = |name: &str| {
        let at = image.find(&format!(" {name}=\"")).expect("an attribute") + name.len() + 3;
        image[at..].split('"').next().expect("its value")
    };
    let file = decoded(value("href").strip_prefix("data:image/png;base64,").expect("a PNG file"));
    let width = u32::from_be_bytes(file[16..20].try_into().expect("4 bytes")) as usize;
    let data = file.windows(4).position(|kind| kind == b"IDAT").expect("pixels") + 4;
    let mut bytes = vec![];
    flate2::read::ZlibDecoder::new(&file[data..]).read_to_end(&mut bytes).expect("they are compressed");
    let rows = bytes.chunks(width + 1).map(|row| row[1..].to_vec()).collect();
    let place = ["x", "y", "width", "height"].map(|name| value(name).parse().expect("a number"));
    Picture { place, width, rows }
}

/// Pixels at the planted frequencies are among the lightest of their column, and the predicted frequencies are drawn within
/// 3 px of them: the rig predicts what was planted, and a row of the picture is 50 Hz or 1 px high.
#[test]
fn reports_show_the_planted_squeal_where_it_is_and_the_prediction_over_it() {
    let simulated = simulated();
    let folder = simulated.folder.path();
    let (out, report) = (text(&folder.join("out")), text(&folder.join("report")));
    let args = ["predict-log", &simulated.log, "--rig", "tribometer", "-o", &out];
    run(args.iter().chain(&["--sound", &simulated.sound, "--unit", "Pa"])).exits(0);
    run(["report", &out, "-o", &report]).exits(0);
    let html = std::fs::read_to_string(Path::new(&report).join("report.html")).expect("the report");
    assert!(html.len() < 4 << 20, "{} bytes", html.len());
    assert!(html.contains("img-src data:") && !html.contains("http://") || !html.contains("src=\"http"));
    let Picture { place: [_, top, _, height], width, rows } = picture(&html);
    let planted = simulated.truth["squeals"].as_array().expect("squeals").iter();
    let planted: Vec<&Value> = planted.filter(|squeal| number(squeal, "frequency_hz") > 1250.0).collect();
    let duration_s = 8.5;
    // Path elements of the predicted frequencies.
    let lines: Vec<f64> = html
        .match_indices("stroke=\"#40E0FF\"")
        .filter_map(|(at, _)| {
            let element = &html[html[..at].rfind('<')?..at + 300.min(html.len() - at)];
            let points = element.split("points=\"").nth(1)?.split('"').next()?;
            points.split(' ').next()?.split(',').nth(1)?.parse().ok()
        })
        .collect();
    assert!(!lines.is_empty(), "no predicted frequency is drawn");
    for planted in planted {
        let hz = number(planted, "frequency_hz");
        let middle_s = 0.5 * (number(planted, "onset_s") + number(planted, "end_s"));
        let x = (middle_s / duration_s * width as f64) as usize;
        let row = rows.len() - 1 - (hz / 20_000.0 * rows.len() as f64) as usize;
        let at = (row - 1..=row + 1).map(|row| rows[row][x]).max().expect("pixels");
        let mut column: Vec<u8> = rows.iter().map(|row| row[x]).collect();
        column.sort_unstable();
        assert!(at > 200 && at > column[column.len() / 2] + 60, "{at} at {hz} Hz, the median is {}", column[200]);
        let y = top + height * (1.0 - hz / 20_000.0);
        let nearest = lines.iter().map(|line| (line - y).abs()).fold(f64::MAX, f64::min);
        assert!(nearest < 3.0 * 8.0, "the nearest prediction is {} px off {hz} Hz", nearest / 8.0);
    }
    for part in
        ["<h2>Predictions against sound</h2>", "recall", "false alarms", "<h3>Occurrence</h3>", "1 applications"]
    {
        assert!(html.contains(part), "{part}");
    }
}
