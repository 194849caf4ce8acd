//! Reads TOML text, environment variables and `--set` flags into one tree of values that remember where they were
//! written.

use super::error::{ConfigError, Origin};
use std::collections::BTreeMap;
use std::sync::Arc;
use toml::de::{DeTable, DeValue};

/// Prefix of environment variables that set a key: `DPM_SET_PROJECTOR__WIDTH=640` sets `projector.width`.
pub const VARIABLE_PREFIX: &str = "DPM_SET_";

/// A value and where it was written.
#[derive(Clone, Debug)]
pub struct SourceNode {
    /// The value.
    pub value: Value,
    /// Where it was written.
    pub origin: Origin,
}

/// The TOML types that a rig file needs.
#[derive(Clone, Debug)]
pub enum Value {
    /// `true` or `false`.
    Bool(bool),
    /// A whole number.
    Integer(i64),
    /// A number with a decimal point.
    Float(f64),
    /// Text in quotes.
    String(String),
    /// Values in square brackets.
    Array(Vec<SourceNode>),
    /// Keys with values.
    Table(BTreeMap<String, Entry>),
    /// Dates, and integers beyond 64 bits. No key accepts them.
    Other(&'static str),
}

/// A key's value, and where the key itself was written.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Where the key was written.
    pub key_origin: Origin,
    /// Its value.
    pub node: SourceNode,
}

impl Value {
    /// The name of the type in messages.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Bool(_) => "a boolean",
            Self::Integer(_) => "an integer",
            Self::Float(_) => "a number with a decimal point",
            Self::String(_) => "a string",
            Self::Array(_) => "an array",
            Self::Table(_) => "a table",
            Self::Other(kind) => kind,
        }
    }
}

/// Converts offsets in a text to lines and columns.
struct Lines<'a> {
    file: Arc<str>,
    text: &'a str,
    starts: Vec<usize>,
}

impl<'a> Lines<'a> {
    fn new(file: &str, text: &'a str) -> Self {
        let starts = std::iter::once(0).chain(text.match_indices('\n').map(|(i, _)| i + 1)).collect();
        Self { file: file.into(), text, starts }
    }

    fn origin(&self, offset: usize) -> Origin {
        let line = self.starts.partition_point(|&s| s <= offset);
        let start = self.starts[line - 1];
        let upto = self.text.get(start..offset.min(self.text.len())).unwrap_or("");
        Origin::File { file: self.file.clone(), line, column: upto.chars().count() + 1 }
    }
}

/// Parses TOML. Every syntax error becomes one entry of `errors`; what could be read is returned.
pub fn parse(file: &str, text: &str, errors: &mut Vec<ConfigError>) -> SourceNode {
    let lines = Lines::new(file, text);
    let (table, problems) = DeTable::parse_recoverable(text);
    for problem in problems {
        errors.push(ConfigError {
            origin: lines.origin(problem.span().map_or(0, |s| s.start)),
            key: String::new(),
            problem: format!("not valid TOML: {}", problem.message().replace('\n', ", ")),
            remedy: String::new(),
        });
    }
    SourceNode { value: table_value(table.get_ref(), &lines), origin: lines.origin(0) }
}

fn table_value(table: &DeTable<'_>, lines: &Lines<'_>) -> Value {
    let mut out = BTreeMap::new();
    for (key, value) in table {
        let node =
            SourceNode { value: value_of(value.get_ref(), lines), origin: lines.origin(value.span().start) };
        let entry = Entry { key_origin: lines.origin(key.span().start), node };
        out.insert(key.get_ref().to_string(), entry);
    }
    Value::Table(out)
}

fn value_of(value: &DeValue<'_>, lines: &Lines<'_>) -> Value {
    match value {
        DeValue::Boolean(b) => Value::Bool(*b),
        DeValue::Integer(i) => i64::from_str_radix(i.as_str(), i.radix())
            .map_or(Value::Other("an integer beyond 64 bits"), Value::Integer),
        DeValue::Float(f) => f.as_str().parse().map_or(Value::Other("an unreadable number"), Value::Float),
        DeValue::String(s) => Value::String(s.to_string()),
        DeValue::Datetime(_) => Value::Other("a date"),
        DeValue::Array(items) => Value::Array(
            items
                .iter()
                .map(|v| SourceNode {
                    value: value_of(v.get_ref(), lines),
                    origin: lines.origin(v.span().start),
                })
                .collect(),
        ),
        DeValue::Table(table) => table_value(table, lines),
    }
}

/// Sets one key of the tree. `path` contains the parts of the dotted key; a numeric part is an index into an array. A
/// text that is not a TOML value counts as a string, so that `render.method=paper` needs no quotes.
pub fn set(
    root: &mut SourceNode,
    path: &[String],
    text: &str,
    origin: &Origin,
    errors: &mut Vec<ConfigError>,
) {
    let mut refuse = |problem: String, remedy: &str| {
        errors.push(ConfigError {
            origin: origin.clone(),
            key: path.join("."),
            problem,
            remedy: remedy.into(),
        });
    };
    if path.is_empty() || path.iter().any(String::is_empty) {
        return refuse("no key before the `=`".into(), "write for example `render.spp=4`");
    }
    let mut at = root;
    for (depth, part) in path.iter().enumerate() {
        let here = path[..depth].join(".");
        at = match &mut at.value {
            Value::Table(table) => {
                let fresh = || Entry {
                    key_origin: origin.clone(),
                    node: SourceNode { value: Value::Table(BTreeMap::new()), origin: origin.clone() },
                };
                &mut table.entry(part.clone()).or_insert_with(fresh).node
            }
            Value::Array(items) => {
                let len = items.len();
                match part.parse::<usize>().ok().filter(|&i| i < len) {
                    Some(i) => &mut items[i],
                    None => {
                        return refuse(
                            format!("`{here}` has {len} elements, and `{part}` is not the index of one"),
                            "count from 0",
                        )
                    }
                }
            }
            other => {
                let kind = other.kind();
                return refuse(format!("`{here}` is {kind}, not a table"), "set the key itself");
            }
        };
    }
    *at = SourceNode { value: value_from_flag(text, origin), origin: origin.clone() };
}

fn value_from_flag(text: &str, origin: &Origin) -> Value {
    let line = format!("v = {text}");
    let mut problems = Vec::new();
    let mut node = parse("", &line, &mut problems);
    let parsed = match &mut node.value {
        Value::Table(table) if problems.is_empty() && table.len() == 1 => table.remove("v"),
        _ => None,
    };
    match parsed {
        Some(mut entry) => {
            stamp(&mut entry.node, origin);
            entry.node.value
        }
        None => Value::String(text.to_string()),
    }
}

/// Everything in a flag's value has the origin of the flag.
fn stamp(node: &mut SourceNode, origin: &Origin) {
    node.origin = origin.clone();
    match &mut node.value {
        Value::Array(items) => items.iter_mut().for_each(|n| stamp(n, origin)),
        Value::Table(table) => table.values_mut().for_each(|e| {
            e.key_origin = origin.clone();
            stamp(&mut e.node, origin);
        }),
        _ => {}
    }
}

/// The dotted key that an environment variable sets; `None` if the variable is not one of ours. Two underscores
/// separate the levels, because keys contain single ones.
pub fn variable_path(name: &str) -> Option<Vec<String>> {
    let rest = name.strip_prefix(VARIABLE_PREFIX)?;
    Some(rest.split("__").map(str::to_lowercase).collect())
}

impl SourceNode {
    /// The same value in the `toml` crate's type; `None` for values that no key accepts.
    pub fn to_toml(&self) -> Option<toml::Value> {
        Some(match &self.value {
            Value::Bool(b) => toml::Value::Boolean(*b),
            Value::Integer(i) => toml::Value::Integer(*i),
            Value::Float(f) => toml::Value::Float(*f),
            Value::String(s) => toml::Value::String(s.clone()),
            Value::Array(items) => {
                toml::Value::Array(items.iter().map(Self::to_toml).collect::<Option<_>>()?)
            }
            Value::Table(table) => toml::Value::Table(
                table.iter().map(|(k, e)| Some((k.clone(), e.node.to_toml()?))).collect::<Option<_>>()?,
            ),
            Value::Other(_) => return None,
        })
    }
}
