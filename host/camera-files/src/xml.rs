//! A small reader of XML: the elements of a text with their attributes and texts. No entities are fetched, no document
//! type is followed, and the depth is bounded.

use super::entries::{inner, Entries, FileEntry, MatrixParts};
use super::StorageError;

/// Deepest nesting that is read.
const DEEPEST: usize = 64;

/// One element.
#[derive(Debug)]
pub(super) struct XmlElement<'a> {
    pub name: &'a str,
    attributes: &'a str,
    /// Its own text, without that of its children.
    pub text: String,
    /// Indices of the elements inside it.
    pub children: Vec<usize>,
    /// Index of the element around it.
    pub parent: Option<usize>,
    /// Whether it is of OpenCV's type `opencv-matrix`.
    is_matrix: bool,
}

/// All elements of a text, in the order in which they start.
#[derive(Debug)]
pub(super) struct Document<'a> {
    pub elements: Vec<XmlElement<'a>>,
}

impl<'a> Document<'a> {
    /// The first child of an element with one of these names, whatever their case.
    pub(super) fn child(&self, of: usize, name: &str) -> Option<usize> {
        let same = |i: &&usize| self.elements[**i].name.eq_ignore_ascii_case(name);
        self.elements[of].children.iter().find(same).copied()
    }

    /// The trimmed text of the child of an element.
    pub(super) fn child_text(&self, of: usize, name: &str) -> Option<&str> {
        Some(self.elements[self.child(of, name)?].text.trim())
    }

    /// Indices of all elements with a name, whatever its case.
    pub(super) fn named<'s>(&'s self, name: &'s str) -> impl Iterator<Item = usize> + 's {
        let same = move |i: &usize| self.elements[*i].name.eq_ignore_ascii_case(name);
        (0..self.elements.len()).filter(same)
    }

    /// The value of an element's attribute, whatever the case of its name.
    pub(super) fn attribute(&self, of: usize, name: &str) -> Option<String> {
        attribute(self.elements[of].attributes, name)
    }

    /// Splits a text into elements.
    pub(super) fn parse(text: &'a str) -> Result<Self, StorageError> {
        let mut elements: Vec<XmlElement<'a>> = Vec::new();
        let mut open: Vec<usize> = Vec::new();
        let mut rest = text;
        loop {
            let wrong = |rest: &str, what: String| {
                let line = text[..text.len() - rest.len()].matches('\n').count() + 1;
                StorageError::Syntax { form: "XML", line, what }
            };
            let Some(at) = rest.find('<') else { break };
            if let Some(&i) = open.last() {
                elements[i].text.push_str(&plain(&rest[..at]));
            }
            rest = &rest[at..];
            let end = end_of_tag(rest).ok_or_else(|| wrong(rest, "a tag does not end".into()))?;
            let tag = rest[1..end].trim_end_matches('>');
            let here = rest;
            rest = &rest[end..];
            if let Some(name) = tag.strip_prefix('/') {
                let name = name.trim();
                match open.pop() {
                    Some(i) if elements[i].name == name => {}
                    Some(i) => return Err(wrong(here, format!("</{name}> closes <{}>", elements[i].name))),
                    None => return Err(wrong(here, format!("</{name}> closes nothing"))),
                }
            } else if !tag.starts_with(['?', '!']) {
                let (tag, empty) = tag.strip_suffix('/').map_or((tag, false), |t| (t, true));
                let (name, attributes) = tag.split_once(char::is_whitespace).unwrap_or((tag, ""));
                if open.len() == DEEPEST {
                    return Err(wrong(here, format!("elements are nested more than {DEEPEST} deep")));
                }
                let (parent, index) = (open.last().copied(), elements.len());
                let is_matrix = attribute(attributes, "type_id").is_some_and(|kind| kind == "opencv-matrix");
                let (text, children) = (String::new(), Vec::new());
                elements.push(XmlElement { name, attributes, text, children, parent, is_matrix });
                if let Some(i) = parent {
                    elements[i].children.push(index);
                }
                if !empty {
                    open.push(index);
                }
            }
        }
        match open.iter().find(|i| elements[**i].is_matrix).or(open.last()) {
            Some(i) => Err(StorageError::matrix(elements[*i].name, "is not closed")),
            None => Ok(Self { elements }),
        }
    }

    /// What an `opencv_storage` holds.
    pub(super) fn entries(&self) -> Result<Entries, StorageError> {
        let mut found = Entries::default();
        // Path of the section inside each element. Members of a sequence, which OpenCV calls `_`, are numbered.
        let mut inside: Vec<String> = Vec::with_capacity(self.elements.len());
        let mut members = vec![0u32; self.elements.len()];
        for (i, element) in self.elements.iter().enumerate() {
            let Some(parent) = element.parent else {
                inside.push(String::new());
                continue;
            };
            let number = members[parent];
            members[parent] += 1;
            let section = inside[parent].clone();
            let name = if element.name == "_" { number.to_string() } else { element.name.to_owned() };
            // A matrix is entered by itself, and only what has children needs a path: so a text of any shape takes no square
            // of its length.
            let path = if element.children.is_empty() || element.is_matrix {
                String::new()
            } else {
                inner(&section, &name)?
            };
            inside.push(path);
            if self.elements[parent].is_matrix {
                continue;
            }
            if element.is_matrix {
                let text = |name| self.child_text(i, name);
                let parts = MatrixParts { rows: text("rows"), columns: text("cols"), kind: text("dt") };
                let data = text("data").ok_or_else(|| StorageError::matrix(element.name, "no data"))?;
                found.add(&section, &name, FileEntry::Matrix(parts.matrix(element.name, data)?));
                continue;
            }
            let words: Vec<&str> = element.text.split_whitespace().collect();
            let numbers: Option<Vec<f64>> = words.iter().map(|w| super::entries::number(w)).collect();
            match (numbers, words.len()) {
                (_, 0) => {}
                (Some(numbers), 2..) => found.add(&section, &name, Entries::list(vec![numbers])),
                _ => found.add(&section, &name, Entries::word(element.text.trim())),
            }
        }
        Ok(found)
    }
}

/// The value of one of a tag's attributes.
fn attribute(mut attributes: &str, name: &str) -> Option<String> {
    while let Some((key, after)) = attributes.split_once('=') {
        let after = after.trim_start();
        let quote = after.chars().next().filter(|c| matches!(c, '"' | '\''))?;
        let (value, next) = after[1..].split_once(quote)?;
        if key.trim().eq_ignore_ascii_case(name) {
            return Some(plain(value));
        }
        attributes = next;
    }
    None
}

/// Length of the tag at the start of `text`, from `<` to `>`. Comments and `CDATA` end where they end.
fn end_of_tag(text: &str) -> Option<usize> {
    for (start, end) in [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>")] {
        if let Some(inside) = text.strip_prefix(start) {
            return Some(inside.find(end)? + start.len() + end.len());
        }
    }
    let mut quote = None;
    for (i, c) in text.char_indices() {
        match quote {
            Some(q) if q == c => quote = None,
            Some(_) => {}
            None if matches!(c, '"' | '\'') => quote = Some(c),
            None if c == '>' => return Some(i + 1),
            None => {}
        }
    }
    None
}

/// A text with the five predefined entities replaced.
fn plain(text: &str) -> String {
    if !text.contains('&') {
        return text.into();
    }
    let text = text.replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", "\"").replace("&apos;", "'");
    text.replace("&amp;", "&")
}
