//! A tree of values into typed sections: every key declared once, with its type, unit, default, range and advice.
//!
//! Errors are collected, never thrown: one run tells everything that is wrong with a file.

use super::error::{ConfigError, Origin};
use super::source::{Entry, Node, Value};
use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::PathBuf;

/// Collects what is wrong and remembers where every key was written.
#[derive(Debug, Default)]
pub(super) struct Reader {
    pub errors: Vec<ConfigError>,
    written: BTreeMap<String, Origin>,
}

impl Reader {
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

    /// Where `key` was written: itself, else the innermost table around it, else [`Origin::Default`].
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

    /// True when somebody wrote `key` itself.
    pub fn is_written(&self, key: &str) -> bool {
        self.written.contains_key(key)
    }

    /// Marks `key` as written at `origin`.
    pub fn mark(&mut self, key: &str, origin: &Origin) {
        self.written.insert(key.to_string(), origin.clone());
    }

    /// The entries of a table, or an error and `None`.
    pub fn table<'n>(&mut self, node: &'n Node, key: &str) -> Option<&'n BTreeMap<String, Entry>> {
        match &node.value {
            Value::Table(table) => Some(table),
            other => {
                self.refuse(&node.origin, key, format!("is {}, must be a table", other.kind()), "");
                None
            }
        }
    }

    /// Refuses every key of `table` that is not in `known`, naming the nearest one that is.
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

/// `section.key`, or `key` at the top.
pub(super) fn join(section: &str, key: &str) -> String {
    if section.is_empty() {
        key.to_string()
    } else {
        format!("{section}.{key}")
    }
}

/// The name in `known` that `name` is most likely a misspelling of: at most two letters or a third of them differ.
fn nearest<'k>(name: &str, known: &[&'k str]) -> Option<&'k str> {
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
    /// Type in words.
    pub kind: String,
    /// Unit; empty where there is none.
    pub unit: &'static str,
    /// Default as it would be written in the file.
    pub default: String,
    /// Allowed values.
    pub range: String,
    /// What it does and when to change it.
    pub doc: String,
}

/// A type that a key can have.
pub(super) trait ConfigValue: Sized {
    /// The type in words.
    fn kind() -> String;
    /// Reads a value; on failure leaves errors and returns `None`.
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self>;
    /// The value as the file would say it.
    fn show(&self) -> String;
    /// Keys below this one, for tables.
    fn docs(_key: &str, _out: &mut Vec<KeyDoc>) {}
}

/// What values a key allows beyond its type.
pub(super) trait Limit<T> {
    /// True when allowed.
    fn allows(&self, value: &T) -> bool;
    /// The allowed values in words.
    fn describe(&self) -> String;
}

/// Every value of the type.
pub(super) struct Any;

impl<T> Limit<T> for Any {
    fn allows(&self, _: &T) -> bool {
        true
    }
    fn describe(&self) -> String {
        String::new()
    }
}

/// A closed interval; arrays and optional values are held to it element by element.
pub(super) struct Within<T>(pub T, pub T);

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

/// A string, path or list with something in it.
pub(super) struct NotEmpty;

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

fn wrong_kind<T: ConfigValue>(node: &Node, reader: &mut Reader, key: &str) -> Option<T> {
    reader.refuse(
        &node.origin,
        key,
        format!("is {}, must be {}", node.value.kind(), T::kind()),
        remedy(&node.value, &T::kind()),
    );
    None
}

/// The usual slips: a quoted number, a decimal point where a whole number is needed.
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
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
            fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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
    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
        let Value::Array(items) = &node.value else { return wrong_kind(node, reader, key) };
        if items.len() > 1024 {
            let problem = format!("has {} elements, may have 1024", items.len());
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

/// Declares a section of the rig file: a struct with defaults, its reader and its part of the manual.
///
/// `name: type = default, "unit", limit;` with doc comments that say what the key does and when to change it.
macro_rules! section {
    (
        $(#[doc = $section_doc:literal])*
        pub struct $section:ident {
            $(
                $(#[doc = $doc:literal])+
                $name:ident: $ty:ty = $default:expr, $unit:literal, $limit:expr;
            )*
        }
    ) => {
        $(#[doc = $section_doc])*
        #[derive(Clone, Debug, PartialEq)]
        pub struct $section {
            $( $(#[doc = $doc])+ pub $name: $ty, )*
        }

        impl Default for $section {
            fn default() -> Self {
                Self { $( $name: $default, )* }
            }
        }

        impl $section {
            /// Names of the section's keys.
            #[allow(dead_code)]
            pub(crate) const KEYS: &'static [&'static str] = &[$( stringify!($name) ),*];

            /// Reads the keys that are present over the defaults, ignoring `kind` and keys that are not its own.
            pub(in crate::config) fn read_keys(
                table: &std::collections::BTreeMap<String, $crate::config::source::Entry>,
                reader: &mut $crate::config::read::Reader,
                section: &str,
            ) -> Self {
                #[allow(unused_imports)]
                use $crate::config::read::{join, ConfigValue, Limit};
                #[allow(unused_mut)]
                let mut out = Self::default();
                let _ = (table, &reader, section);
                $(
                    if let Some(entry) = table.get(stringify!($name)) {
                        let key = join(section, stringify!($name));
                        reader.mark(&key, &entry.node.origin);
                        if let Some(value) = <$ty as ConfigValue>::read(&entry.node, reader, &key) {
                            let limit = $limit;
                            if Limit::<$ty>::allows(&limit, &value) {
                                out.$name = value;
                            } else {
                                let problem = format!(
                                    "is {}, must be {}{}",
                                    ConfigValue::show(&value),
                                    Limit::<$ty>::describe(&limit),
                                    if $unit.is_empty() { String::new() } else { format!(" {}", $unit) },
                                );
                                reader.refuse(&entry.node.origin, &key, problem, "");
                            }
                        }
                    }
                )*
                out
            }

            /// The section's keys for the manual.
            pub(in crate::config) fn document(section: &str, out: &mut Vec<$crate::config::read::KeyDoc>) {
                #[allow(unused_imports)]
                use $crate::config::read::{join, ConfigValue, KeyDoc, Limit};
                let default = Self::default();
                let _ = (&default, section, &out);
                $(
                    let mut below = Vec::new();
                    <$ty as ConfigValue>::docs(&join(section, stringify!($name)), &mut below);
                    if below.is_empty() {
                        out.push(KeyDoc {
                            key: join(section, stringify!($name)),
                            kind: <$ty as ConfigValue>::kind(),
                            unit: $unit,
                            default: ConfigValue::show(&default.$name),
                            range: Limit::<$ty>::describe(&$limit),
                            doc: [$($doc),+].map(str::trim).join(" "),
                        });
                    } else {
                        out.append(&mut below);
                    }
                )*
            }
        }

        impl $crate::config::read::ConfigValue for $section {
            fn kind() -> String {
                "a table".into()
            }
            fn read(
                node: &$crate::config::source::Node,
                reader: &mut $crate::config::read::Reader,
                key: &str,
            ) -> Option<Self> {
                let table = reader.table(node, key)?;
                reader.unknown_keys(table, key, Self::KEYS);
                Some(Self::read_keys(table, reader, key))
            }
            fn show(&self) -> String {
                "{}".into()
            }
            fn docs(key: &str, out: &mut Vec<$crate::config::read::KeyDoc>) {
                Self::document(key, out);
            }
        }
    };
}

/// Declares a choice between words: `Variant = "word"`.
macro_rules! words {
    (
        $(#[doc = $enum_doc:literal])*
        pub enum $name:ident { $( $(#[doc = $doc:literal])+ $variant:ident = $word:literal, )+ }
    ) => {
        $(#[doc = $enum_doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name { $( $(#[doc = $doc])+ $variant, )+ }

        impl $name {
            /// The word in the rig file and in reports.
            pub const fn word(self) -> &'static str {
                match self { $( Self::$variant => $word, )+ }
            }
        }

        impl $crate::config::read::ConfigValue for $name {
            fn kind() -> String {
                [$( concat!("\"", $word, "\"") ),+].join(" | ")
            }
            fn read(
                node: &$crate::config::source::Node,
                reader: &mut $crate::config::read::Reader,
                key: &str,
            ) -> Option<Self> {
                match &node.value {
                    $( $crate::config::source::Value::String(s) if s == $word => Some(Self::$variant), )+
                    $crate::config::source::Value::String(s) => {
                        let problem = format!("is {s:?}, must be one of {}", Self::kind());
                        reader.refuse(&node.origin, key, problem, "");
                        None
                    }
                    other => {
                        let problem = format!("is {}, must be one of {}", other.kind(), Self::kind());
                        reader.refuse(&node.origin, key, problem, "");
                        None
                    }
                }
            }
            fn show(&self) -> String {
                format!("{:?}", self.word())
            }
        }
    };
}

/// Declares a table whose key `kind` decides which other keys it takes: `Variant(Section) = "kind"`.
macro_rules! kinds {
    (
        $(#[doc = $enum_doc:literal])*
        pub enum $name:ident { $( $(#[doc = $doc:literal])+ $variant:ident($section:ty) = $word:literal, )+ }
        default $default:ident
    ) => {
        $(#[doc = $enum_doc])*
        #[derive(Clone, Debug, PartialEq)]
        pub enum $name { $( $(#[doc = $doc])+ $variant($section), )+ }

        impl Default for $name {
            fn default() -> Self {
                Self::$default(Default::default())
            }
        }

        impl $name {
            /// The kind's word in the rig file and in reports.
            pub const fn word(&self) -> &'static str {
                match self { $( Self::$variant(_) => $word, )+ }
            }
        }

        impl $crate::config::read::ConfigValue for $name {
            fn kind() -> String {
                "a table".into()
            }
            fn read(
                node: &$crate::config::source::Node,
                reader: &mut $crate::config::read::Reader,
                key: &str,
            ) -> Option<Self> {
                use $crate::config::read::join;
                use $crate::config::source::Value;
                let table = reader.table(node, key)?;
                let words: &[&str] = &[$( $word ),+];
                let default = Self::default();
                if let Some(entry) = table.get("kind") {
                    reader.mark(&join(key, "kind"), &entry.node.origin);
                }
                let word = match table.get("kind") {
                    None => default.word(),
                    Some(entry) => match &entry.node.value {
                        Value::String(s) if words.contains(&s.as_str()) => {
                            words.iter().find(|w| **w == s).copied().unwrap_or(default.word())
                        }
                        other => {
                            let shown = match other {
                                Value::String(s) => format!("{s:?}"),
                                other => other.kind().to_string(),
                            };
                            let quoted: Vec<String> = words.iter().map(|w| format!("{w:?}")).collect();
                            let problem = format!("is {shown}, must be one of {}", quoted.join(" | "));
                            reader.refuse(&entry.node.origin, &join(key, "kind"), problem, "");
                            return None;
                        }
                    },
                };
                let known = match word { $( $word => <$section>::KEYS, )+ _ => &[] };
                for (name, entry) in table {
                    if name == "kind" || known.contains(&name.as_str()) {
                        continue;
                    }
                    let owners: Vec<&str> = [$( ($word, <$section>::KEYS) ),+]
                        .iter()
                        .filter(|(_, keys)| keys.contains(&name.as_str()))
                        .map(|(w, _)| *w)
                        .collect();
                    if owners.is_empty() {
                        let all: Vec<&str> = known.iter().copied().chain(["kind"]).collect();
                        let only = std::collections::BTreeMap::from([(name.clone(), entry.clone())]);
                        reader.unknown_keys(&only, key, &all);
                    } else {
                        reader.refuse(
                            &entry.key_origin,
                            &join(key, name),
                            format!("does not belong to kind = {word:?}"),
                            format!("remove it or choose kind = {:?}", owners.join(" or ")),
                        );
                    }
                }
                match word {
                    $( $word => Some(Self::$variant(<$section>::read_keys(table, reader, key))), )+
                    _ => None,
                }
            }
            fn show(&self) -> String {
                format!("{{ kind = {:?} }}", self.word())
            }
            fn docs(key: &str, out: &mut Vec<$crate::config::read::KeyDoc>) {
                use $crate::config::read::{join, KeyDoc};
                out.push(KeyDoc {
                    key: join(key, "kind"),
                    kind: [$( concat!("\"", $word, "\"") ),+].join(" | "),
                    unit: "",
                    default: format!("{:?}", Self::default().word()),
                    range: String::new(),
                    doc: [$( format!("`{}`: {}", $word, [$($doc),+].map(str::trim).join(" ")) ),+].join(" "),
                });
                $( <$section>::document(&format!("{key}({})", $word), out); )+
            }
        }
    };
}

pub(super) use {kinds, section, words};
