//! A report into one HTML file that needs nothing else: no script, no font, no file beside it, no address.

use super::markdown::MarkdownBlock;
use super::table::Table;
use base64::Engine;
use std::fmt::Write;

/// A part of the page.
#[derive(Clone, Debug)]
pub(crate) enum PagePart {
    /// A heading.
    Heading(String),
    /// A paragraph.
    Text(String),
    /// Items.
    List(Vec<String>),
    /// A table.
    Table(Table),
    /// A plot as SVG, which [`dpm_profile::svg::is_plain_svg`] has accepted.
    Plot(String),
    /// A PNG picture with its name.
    Picture(String, Vec<u8>),
    /// Lines of fixed width, folded away under a title.
    Folded(String, String),
}

impl From<MarkdownBlock> for PagePart {
    fn from(block: MarkdownBlock) -> Self {
        match block {
            MarkdownBlock::Heading(text) => Self::Heading(text),
            MarkdownBlock::Table(table) => Self::Table(table),
            MarkdownBlock::List(items) => Self::List(items),
            MarkdownBlock::Paragraph(text) => Self::Text(text),
        }
    }
}

/// The browser itself refuses whatever would come from outside.
const HEAD: &str = r#"<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
"#;

const STYLE: &str = "<style>
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; }
h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc; }
.scroll { overflow-x: auto; margin: .6rem 0 1.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .2rem 0; }
caption, td:first-child { white-space: nowrap; }
th, td { padding: .15rem .7rem .15rem 0; text-align: right; vertical-align: top; border-bottom: 1px solid #eee; }
th { font-weight: 600; color: #555; }
td.text, th.text { text-align: left; }
svg, img { max-width: 100%; height: auto; display: block; margin: .8rem 0; }
figure { margin: 1rem 0; } figcaption { color: #555; }
pre { font-size: 12px; overflow-x: auto; background: #f6f6f6; padding: .6rem; }
@media print { body { margin: 0; max-width: none; } h2 { break-after: avoid; } table, svg, img { break-inside: avoid; } }
</style>
";

/// The page.
pub(crate) fn page(title: &str, parts: &[PagePart]) -> String {
    let title = escaped(title);
    let mut out = format!("{HEAD}<title>{title}</title>\n{STYLE}</head><body>\n<h1>{title}</h1>\n");
    parts.iter().for_each(|part| add(&mut out, part));
    out + "</body></html>\n"
}

// Writing into a string cannot fail.
fn add(out: &mut String, part: &PagePart) {
    let _ = match part {
        PagePart::Heading(text) => writeln!(out, "<h2>{}</h2>", escaped(text)),
        PagePart::Text(text) => writeln!(out, "<p>{}</p>", prose(text)),
        PagePart::List(items) => {
            let items: String = items.iter().map(|item| format!("<li>{}</li>\n", prose(item))).collect();
            writeln!(out, "<ul>\n{items}</ul>")
        }
        PagePart::Table(table) => add_table(out, table),
        PagePart::Plot(svg) => writeln!(out, "<figure>{}</figure>", svg.trim()),
        PagePart::Picture(name, bytes) => {
            let (name, data) = (escaped(name), base64::engine::general_purpose::STANDARD.encode(bytes));
            writeln!(
                out,
                "<figure><img alt=\"{name}\" src=\"data:image/png;base64,{data}\"><figcaption>{name}</figcaption></figure>"
            )
        }
        PagePart::Folded(title, text) => writeln!(
            out,
            "<details><summary>{}</summary>\n<pre>{}</pre></details>",
            escaped(title),
            escaped(text)
        ),
    };
}

fn add_table(out: &mut String, table: &Table) -> std::fmt::Result {
    // A column of numbers stands to the right, one with words to the left.
    let is_number = |text: &str| {
        text.is_empty() || text == "-" || text.trim_end_matches('%').trim().parse::<f64>().is_ok()
    };
    let is_text =
        |k: usize| !table.rows.iter().all(|row| row.get(k).is_none_or(|cell| is_number(&cell.shown)));
    let class: Vec<&str> =
        (0..table.head.len()).map(|k| if is_text(k) { " class=\"text\"" } else { "" }).collect();
    let line = |tag: &str, cells: &mut dyn Iterator<Item = &str>| -> String {
        let cells = cells.zip(&class).map(|(text, class)| format!("<{tag}{class}>{}</{tag}>", prose(text)));
        format!("<tr>{}</tr>\n", cells.collect::<String>())
    };
    let head = line("th", &mut table.head.iter().map(String::as_str));
    let rows: String =
        table.rows.iter().map(|row| line("td", &mut row.iter().map(|cell| cell.shown.as_str()))).collect();
    let title = escaped(&table.title);
    writeln!(
        out,
        "<div class=\"scroll\"><table><caption>{title}</caption>\n<thead>{head}</thead><tbody>\n{rows}</tbody></table></div>"
    )
}

/// Text as HTML, with what stands between backquotes as code.
fn prose(text: &str) -> String {
    let pieces: Vec<String> = text.split('`').map(escaped).collect();
    if pieces.len().is_multiple_of(2) {
        // A backquote without a partner is a backquote.
        return escaped(text);
    }
    let piece = |(i, piece): (usize, &String)| match i % 2 {
        0 => piece.clone(),
        _ => format!("<code>{piece}</code>"),
    };
    pieces.iter().enumerate().map(piece).collect()
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::table::Cell;
    use dpm_profile::svg::is_plain_svg;

    #[test]
    fn nothing_in_a_text_becomes_a_part_of_the_page() {
        let evil = "<script>alert(1)</script>\" onload=\"x";
        let table = Table { title: evil.into(), head: vec![evil.into()], rows: vec![vec![Cell::text(evil)]] };
        let parts = [
            PagePart::Heading(evil.into()),
            PagePart::Text(evil.into()),
            PagePart::List(vec![evil.into()]),
            PagePart::Table(table),
            PagePart::Picture(evil.into(), vec![1]),
            PagePart::Folded(evil.into(), evil.into()),
        ];
        let page = page(evil, &parts);
        assert!(!page.contains("<script") && !page.contains("\" onload"), "{page}");
        assert_eq!(page.matches("&lt;script&gt;").count(), 12);
    }

    #[test]
    fn only_plain_shapes_are_plots() {
        let svg = |inner: &str| format!("<svg width=\"1\">\n{inner}</svg>\n");
        assert!(is_plain_svg(&svg("<rect x=\"0\"/>\n<text x=\"1\">99 &lt; 100 only</text>")));
        for evil in [
            "<script>1</script>",
            "<image href=\"http://x\"/>",
            "<rect onload=\"x()\"/>",
            "<rect fill=\"url(#a)\"/>",
            "<a href=\"x\">y</a>",
            "<rect",
            "<style>*{}</style>",
            "<!-- -->",
        ] {
            assert!(!is_plain_svg(&svg(evil)), "{evil}");
        }
        assert!(!is_plain_svg("<svg>") && !is_plain_svg("") && !is_plain_svg("</svg>"));
    }

    #[test]
    fn code_stands_between_backquotes() {
        assert_eq!(prose("set `a<b` now"), "set <code>a&lt;b</code> now");
        assert_eq!(prose("a ` b"), "a ` b");
    }
}
