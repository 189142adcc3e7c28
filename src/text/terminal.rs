//! Output to a terminal. The text may contain names from files of unknown origin.

use std::borrow::Cow;
use std::fmt;
use std::io::Write;

/// The text with control characters written as escapes (`\u{1b}`), so that a name cannot move the cursor, change
/// colours or set the window title. Line breaks and tabs are kept.
pub fn printable(text: &str) -> Cow<'_, str> {
    let acts = |c: char| c.is_control() && c != '\n' && c != '\t';
    if !text.contains(acts) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        if acts(c) { shown.extend(c.escape_default()) } else { shown.push(c) }
    }
    Cow::Owned(shown)
}

/// Writes a line to standard error. Errors are ignored, since there may be no reader.
pub fn note(text: fmt::Arguments<'_>) {
    let line = format!("{text}\n");
    let _ = std::io::stderr().write_all(printable(&line).as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_written_as_escapes() {
        assert_eq!(printable("rig µ\t1\n"), "rig µ\t1\n");
        // ESC and BEL set the window title; U+009B is a CSI in one character.
        assert_eq!(printable("a\u{1b}]0;b\u{7}c\u{9b}2J\r\u{7f}"), "a\\u{1b}]0;b\\u{7}c\\u{9b}2J\\r\\u{7f}");
    }
}
