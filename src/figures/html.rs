//! Self-contained HTML pages in a common style, which load nothing from elsewhere.

const STYLE: &str = include_str!("../display/assets/report.css");

/// A whole page; `body` is HTML.
pub fn page(title: &str, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">\n\
         <title>{}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n{body}</main>\n</body>\n</html>\n",
        escaped(title)
    )
}

/// A section with a heading; `title` and `body` are HTML.
pub fn section(title: &str, body: &str) -> String {
    format!("<section>\n<h2>{title}</h2>\n{body}</section>\n")
}

/// A table of names and values, both plain text.
pub fn facts<N: AsRef<str>, V: AsRef<str>>(rows: impl IntoIterator<Item = (N, V)>) -> String {
    let row = |(name, value): (N, V)| {
        format!("<tr><th scope=\"row\">{}</th><td>{}</td></tr>\n", escaped(name.as_ref()), escaped(value.as_ref()))
    };
    format!("<table class=\"facts\"><tbody>\n{}</tbody></table>\n", rows.into_iter().map(row).collect::<String>())
}

/// A figure of [`crate::figures::plot`] with a caption in HTML.
pub fn figure(svg: &str, caption: &str) -> String {
    // Drops the XML declaration, which only a separate file needs.
    let svg = svg.find("<svg").map_or(svg, |start| &svg[start..]);
    // Focusable, so that the keyboard can scroll it if it is wider than the screen.
    format!(
        "<figure><p class=\"wide\">Wider than the screen: scroll it sideways →</p>\
         <div class=\"figure\" tabindex=\"0\" role=\"group\" aria-label=\"Figure, scrolls sideways\">{svg}</div>\
         <figcaption>{caption}</figcaption></figure>\n"
    )
}

/// Escapes plain text for HTML.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_escaped_and_figures_are_not() {
        assert_eq!(escaped("<a href=\"x\">&"), "&lt;a href=&quot;x&quot;&gt;&amp;");
        assert!(page("a < b", "").contains("<title>a &lt; b</title>"));
        let figure = figure("<?xml?>\n<svg></svg>", "c");
        assert!(figure.contains("><svg></svg></div>") && !figure.contains("<?xml"), "{figure}");
        assert!(figure.contains("scroll it sideways") && figure.contains("tabindex=\"0\""), "{figure}");
    }
}
