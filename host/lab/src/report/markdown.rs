//! The Markdown that this program writes itself into blocks: headings, tables, lists and paragraphs. It is not a reader of any
//! other Markdown.

use super::table::{Cell, Table};

/// A part of a text.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum MarkdownBlock {
    /// A heading.
    Heading(String),
    /// A table, named by the heading or the sentence above it.
    Table(Table),
    /// The items of a list.
    List(Vec<String>),
    /// A paragraph.
    Paragraph(String),
}

/// The blocks of `text`. Tables without a heading above are named `name` with their number.
pub(crate) fn blocks(name: &str, text: &str) -> Vec<MarkdownBlock> {
    let mut out = Vec::new();
    let mut heading = String::new();
    let mut tables = 0;
    for part in text.replace("\r\n", "\n").split("\n\n").map(str::trim).filter(|part| !part.is_empty()) {
        let lines: Vec<&str> = part.lines().collect();
        if let Some(title) = part.strip_prefix('#').filter(|_| lines.len() == 1) {
            heading = title.trim_start_matches('#').trim().to_owned();
            out.push(MarkdownBlock::Heading(heading.clone()));
        } else if let [head, rule, rows @ ..] = &lines[..] {
            if head.starts_with('|') && rule.trim_matches(['|', '-', ':', ' ']).is_empty() {
                tables += 1;
                let title = if heading.is_empty() {
                    format!("{name} {tables}")
                } else {
                    format!("{heading} {tables}")
                };
                out.push(MarkdownBlock::Table(table(title, head, rows)));
            } else {
                out.push(prose(&lines));
            }
        } else {
            out.push(prose(&lines));
        }
    }
    out
}

fn prose(lines: &[&str]) -> MarkdownBlock {
    if lines.iter().all(|line| line.starts_with("- ")) {
        return MarkdownBlock::List(lines.iter().map(|line| line[2..].to_owned()).collect());
    }
    MarkdownBlock::Paragraph(lines.join(" "))
}

fn table(title: String, head: &str, rows: &[&str]) -> Table {
    let cells = |line: &str| -> Vec<String> {
        line.trim().trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect()
    };
    let head = cells(head);
    let row = |line: &&str| {
        let mut row: Vec<Cell> = cells(line).into_iter().map(Cell::text).collect();
        row.resize(head.len(), Cell::default());
        row
    };
    Table { title, rows: rows.iter().map(row).collect(), head }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_cut_into_its_blocks() {
        let text =
            "## Errors\n\nTwo runs,\none device.\n\n| a | b |\n|---|---:|\n| 1 | 2 |\n| 3 |\n\n- x\n- y\n";
        let parts = blocks("error", text);
        let [MarkdownBlock::Heading(heading), MarkdownBlock::Paragraph(told), MarkdownBlock::Table(table), MarkdownBlock::List(list)] =
            &parts[..]
        else {
            panic!("{parts:?}");
        };
        assert_eq!((heading.as_str(), told.as_str(), list.len()), ("Errors", "Two runs, one device.", 2));
        assert_eq!((table.title.as_str(), &table.head), ("Errors 1", &vec!["a".to_owned(), "b".to_owned()]));
        assert_eq!(table.to_csv(), "a,b\r\n1,2\r\n3,\r\n");
    }
}
