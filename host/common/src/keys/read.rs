//! Reads a tree of values into typed sections. Every key is declared once, with its type, unit, default, range and
//! advice.
//!
//! Errors are collected, so that one run reports everything that is wrong with a file.

use super::error::{ConfigError, Origin};
use super::source::{Entry, SourceNode, Value};
use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::PathBuf;

/// Collects errors and remembers where every key was written.
#[derive(Debug, Default)]
pub struct KeyReader {
    /// What is wrong so far.
    pub errors: Vec<ConfigError>,
    written: BTreeMap<String, Origin>,
}

impl KeyReader {
    /// Adds an error about `key`, written at `origin`.
    pub fn refuse(
        &mut self,
        origin: &Origin,
        key: &str,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) {
        self.errors.push(ConfigError {
            origin: origin.clone(),
            key: key.into(),
            problem: problem.into(),
            remedy: remedy.into(),
        });
    }

    /// Where `key` was written: the key itself, else the innermost table around it, else [`Origin::Default`].
    pub fn origin_of(&self, key: &str) -> Origin {
        let mut key = key;
        loop {
            if let Some(origin) = self.written.get(key) {
                return origin.clone();
            }
            match key.rfind('.') {
                Some(dot) => key = &key[..dot],
                None => return Origin::Default,
            }
        }
    }

    /// True if `key` itself was written.
    pub fn is_written(&self, key: &str) -> bool {
        self.written.contains_key(key)
    }

    /// Marks `key` as written at `origin`.
    pub fn mark(&mut self, key: &str, origin: &Origin) {
        self.written.insert(key.to_string(), origin.clone());
    }

    /// The entries of a table, or an error and `None`.
    pub fn table<'n>(&mut self, node: &'n SourceNode, key: &str) -> Option<&'n BTreeMap<String, Entry>> {
        match &node.value {
            Value::Table(table) => Some(table),
            other => {
                self.refuse(&node.origin, key, format!("is {}, must be a table", other.kind()), "");
                None
            }
        }
    }

    /// Refuses every key of `table` that is not in `known`, and suggests the most similar known key.
    pub fn unknown_keys(&mut self, table: &BTreeMap<String, Entry>, section: &str, known: &[&str]) {
        for (name, entry) in table {
            if known.contains(&name.as_str()) {
                continue;
            }
            let remedy = match nearest(name, known) {
                Some(near) => format!("did you mean `{near}`?"),
                None => format!("known keys here: {}", known.join(", ")),
            };
            self.refuse(&entry.key_origin, &join(section, name), "unknown key", remedy);
        }
    }
}

/// Refuses several keys that contradict each other, at the first of them that was written. The message names all of
/// them with their values, so that nobody must guess which other key is involved. `problem` itself names the keys
/// with an empty value.
pub fn contradict(reader: &mut KeyReader, keys: &[(&str, String)], problem: &str, remedy: String) {
    let at = keys.iter().position(|(key, _)| reader.is_written(key)).unwrap_or(0);
    let (key, value) = &keys[at];
    let others = keys.iter().enumerate().filter(|(i, _)| *i != at);
    let others: Vec<String> = others.map(|(_, (key, value))| format!("`{key}` = {value}")).collect();
    let origin = reader.origin_of(key);
    reader.refuse(&origin, key, format!("is {value}, with {}: {problem}", others.join(" and ")), remedy);
}

/// A value as written in the rig file.
pub fn shown(value: impl ConfigValue) -> String {
    value.show()
}

/// Refuses at the first of `keys` that was written.
pub fn refuse(reader: &mut KeyReader, keys: &[&str], problem: String, remedy: String) {
    let key = keys.iter().find(|k| reader.is_written(k)).unwrap_or(&keys[0]);
    let origin = reader.origin_of(key);
    reader.refuse(&origin, key, problem, remedy);
}

/// `section.key`, or `key` at the top.
pub fn join(section: &str, key: &str) -> String {
    if section.is_empty() {
        key.to_string()
    } else {
        format!("{section}.{key}")
    }
}

/// The name in `known` of which `name` is most likely a misspelling: at most two letters or a third of them differ.
pub fn nearest<'k>(name: &str, known: &[&'k str]) -> Option<&'k str> {
    let limit = (name.chars().count() / 3).max(if name.len() > 3 { 2 } else { 1 });
    known.iter().map(|k| (edit_distance(name, k), *k)).filter(|(d, _)| *d <= limit).min().map(|(_, k)| k)
}

/// Levenshtein distance.
fn edit_distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().take(64).enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let above = row[j + 1];
            row[j + 1] = (diagonal + usize::from(ca != *cb)).min(above + 1).min(row[j] + 1);
            diagonal = above;
        }
    }
    row[b.len()]
}

/// One key of the rig file, for the manual.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeyDoc {
    /// Dotted key.
    pub key: String,
    /// The type as text.
    pub kind: String,
    /// The unit; empty if there is none.
    pub unit: &'static str,
    /// The default, as written in the file.
    pub default: String,
    /// Allowed values.
    pub range: String,
    /// What it does and when to change it.
    pub doc: String,
}

/// A type that a key can have.
pub trait ConfigValue: Sized {
    /// The type as text.
    fn kind() -> String;
    /// Reads a value. On failure adds errors and returns `None`.
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self>;
    /// The value as written in the file.
    fn show(&self) -> String;
    /// Keys below this one, for tables.
    fn docs(_key: &str, _out: &mut Vec<KeyDoc>) {}
}

/// The values that a key permits beyond its type.
pub trait Limit<T> {
    /// True if the value is permitted.
    fn allows(&self, value: &T) -> bool;
    /// The permitted values as text.
    fn describe(&self) -> String;
}

/// Every value of the type.
pub struct Any;

impl<T> Limit<T> for Any {
    fn allows(&self, _: &T) -> bool {
        true
    }
    fn describe(&self) -> String {
        String::new()
    }
}

/// A closed interval. It applies to each element of arrays and optional values.
pub struct Within<T>(pub T, pub T);

impl<T: PartialOrd + Display> Limit<T> for Within<T> {
    fn allows(&self, value: &T) -> bool {
        *value >= self.0 && *value <= self.1
    }
    fn describe(&self) -> String {
        format!("{} to {}", self.0, self.1)
    }
}

impl<T: PartialOrd + Display> Limit<Option<T>> for Within<T> {
    fn allows(&self, value: &Option<T>) -> bool {
        value.as_ref().is_none_or(|v| self.allows(v))
    }
    fn describe(&self) -> String {
        Limit::<T>::describe(self)
    }
}

impl<T: PartialOrd + Display, const N: usize> Limit<[T; N]> for Within<T> {
    fn allows(&self, value: &[T; N]) -> bool {
        value.iter().all(|v| self.allows(v))
    }
    fn describe(&self) -> String {
        format!("each {}", Limit::<T>::describe(self))
    }
}

impl<T: PartialOrd + Display, const N: usize> Limit<Option<[T; N]>> for Within<T> {
    fn allows(&self, value: &Option<[T; N]>) -> bool {
        value.as_ref().is_none_or(|v| self.allows(v))
    }
    fn describe(&self) -> String {
        Limit::<[T; N]>::describe(self)
    }
}

/// A non-empty string, path or list.
pub struct NotEmpty;

impl Limit<String> for NotEmpty {
    fn allows(&self, value: &String) -> bool {
        !value.trim().is_empty()
    }
    fn describe(&self) -> String {
        "not empty".into()
    }
}

impl Limit<PathBuf> for NotEmpty {
    fn allows(&self, value: &PathBuf) -> bool {
        !value.as_os_str().is_empty()
    }
    fn describe(&self) -> String {
        "not empty".into()
    }
}

impl<T> Limit<Option<T>> for NotEmpty
where
    NotEmpty: Limit<T>,
{
    fn allows(&self, value: &Option<T>) -> bool {
        value.as_ref().is_none_or(|v| self.allows(v))
    }
    fn describe(&self) -> String {
        "not empty".into()
    }
}

fn wrong_kind<T: ConfigValue>(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<T> {
    reader.refuse(
        &node.origin,
        key,
        format!("is {}, must be {}", node.value.kind(), T::kind()),
        remedy(&node.value, &T::kind()),
    );
    None
}

/// Advice for frequent mistakes: a quoted number, or a decimal point in a whole number.
fn remedy(value: &Value, wanted: &str) -> String {
    match value {
        Value::String(s) if wanted.contains("number") && s.trim().parse::<f64>().is_ok() => {
            format!("write {} without quotes", s.trim())
        }
        Value::String(s) if wanted == "a boolean" && (s == "true" || s == "false") => {
            format!("write {s} without quotes")
        }
        Value::Float(f) if wanted.contains("whole") && f.fract() == 0.0 && f.abs() < 1e15 => {
            format!("write {f} without the decimal point")
        }
        _ => String::new(),
    }
}

impl ConfigValue for bool {
    fn kind() -> String {
        "a boolean".into()
    }
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        match node.value {
            Value::Bool(b) => Some(b),
            _ => wrong_kind(node, reader, key),
        }
    }
    fn show(&self) -> String {
        self.to_string()
    }
}

impl ConfigValue for f64 {
    fn kind() -> String {
        "a number".into()
    }
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        match node.value {
            Value::Float(f) if f.is_finite() => Some(f),
            Value::Float(_) => {
                reader.refuse(&node.origin, key, "is not finite, must be a finite number", "");
                None
            }
            Value::Integer(i) => Some(i as f64),
            _ => wrong_kind(node, reader, key),
        }
    }
    fn show(&self) -> String {
        format!("{self:?}")
    }
}

macro_rules! integer_value {
    ($($t:ty),*) => {$(
        impl ConfigValue for $t {
            fn kind() -> String {
                "a whole number".into()
            }
            fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
                match node.value {
                    Value::Integer(i) => match <$t>::try_from(i) {
                        Ok(v) => Some(v),
                        Err(_) => {
                            let problem = format!("is {i}, must be {} to {}", <$t>::MIN, <$t>::MAX);
                            reader.refuse(&node.origin, key, problem, "");
                            None
                        }
                    },
                    _ => wrong_kind(node, reader, key),
                }
            }
            fn show(&self) -> String {
                self.to_string()
            }
        }
    )*};
}
integer_value!(u8, u16, u32, u64, i64);

impl ConfigValue for String {
    fn kind() -> String {
        "a string".into()
    }
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        match &node.value {
            Value::String(s) => Some(s.clone()),
            _ => wrong_kind(node, reader, key),
        }
    }
    fn show(&self) -> String {
        format!("{self:?}")
    }
}

impl ConfigValue for PathBuf {
    fn kind() -> String {
        "a path".into()
    }
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        match &node.value {
            Value::String(s) if s.contains('\0') => {
                reader.refuse(&node.origin, key, "contains a NUL character", "");
                None
            }
            Value::String(s) => Some(s.into()),
            _ => wrong_kind(node, reader, key),
        }
    }
    fn show(&self) -> String {
        format!("{:?}", self.display().to_string())
    }
}

impl<T: ConfigValue> ConfigValue for Option<T> {
    fn kind() -> String {
        format!("{}, optional", T::kind())
    }
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        T::read(node, reader, key).map(Some)
    }
    fn show(&self) -> String {
        self.as_ref().map_or("none".into(), T::show)
    }
    fn docs(key: &str, out: &mut Vec<KeyDoc>) {
        T::docs(key, out);
    }
}

impl<T: ConfigValue, const N: usize> ConfigValue for [T; N] {
    fn kind() -> String {
        format!("an array of {N}, each {}", T::kind())
    }
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let Value::Array(items) = &node.value else { return wrong_kind(node, reader, key) };
        if items.len() != N {
            let problem = format!("has {} elements, must have {N}", items.len());
            reader.refuse(&node.origin, key, problem, "");
            return None;
        }
        let read: Vec<Option<T>> = items
            .iter()
            .enumerate()
            .map(|(i, item)| T::read(item, reader, &join(key, &i.to_string())))
            .collect();
        read.into_iter().collect::<Option<Vec<T>>>()?.try_into().ok()
    }
    fn show(&self) -> String {
        format!("[{}]", self.iter().map(T::show).collect::<Vec<_>>().join(", "))
    }
}

impl<T: ConfigValue> ConfigValue for Vec<T> {
    fn kind() -> String {
        format!("a list, each {}", T::kind())
    }
    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let Value::Array(items) = &node.value else { return wrong_kind(node, reader, key) };
        if items.len() > 1024 {
            let problem = format!("has {} elements, must have at most 1024", items.len());
            reader.refuse(&node.origin, key, problem, "");
            return None;
        }
        let read: Vec<Option<T>> = items
            .iter()
            .enumerate()
            .map(|(i, item)| {
                let key = join(key, &i.to_string());
                reader.mark(&key, &item.origin);
                T::read(item, reader, &key)
            })
            .collect();
        read.into_iter().collect()
    }
    fn show(&self) -> String {
        format!("[{}]", self.iter().map(T::show).collect::<Vec<_>>().join(", "))
    }
    fn docs(key: &str, out: &mut Vec<KeyDoc>) {
        T::docs(&format!("{key}[]"), out);
    }
}
