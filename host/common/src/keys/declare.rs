//! Declares each key in one place; the macros generate structs with defaults, their readers and their part of the
//! manual.

/// Declares a section of the rig file: a struct with defaults, its reader and its part of the manual.
///
/// The form is `name: type = default, "unit", limit;` with doc comments that say what the key does and when to change
/// it.
#[macro_export]
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

            /// Replaces the defaults by the keys that are present. Ignores `kind` and keys of other sections.
            pub(crate) fn read_keys(
                table: &std::collections::BTreeMap<String, $crate::keys::source::Entry>,
                reader: &mut $crate::keys::read::Reader,
                section: &str,
            ) -> Self {
                #[allow(unused_imports)]
                use $crate::keys::read::{join, ConfigValue, Limit};
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
            pub(crate) fn document(section: &str, out: &mut Vec<$crate::keys::read::KeyDoc>) {
                #[allow(unused_imports)]
                use $crate::keys::read::{join, ConfigValue, KeyDoc, Limit};
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

        impl $crate::keys::read::ConfigValue for $section {
            fn kind() -> String {
                "a table".into()
            }
            fn read(
                node: &$crate::keys::source::Node,
                reader: &mut $crate::keys::read::Reader,
                key: &str,
            ) -> Option<Self> {
                let table = reader.table(node, key)?;
                reader.unknown_keys(table, key, Self::KEYS);
                Some(Self::read_keys(table, reader, key))
            }
            fn show(&self) -> String {
                "{}".into()
            }
            fn docs(key: &str, out: &mut Vec<$crate::keys::read::KeyDoc>) {
                Self::document(key, out);
            }
        }
    };
}

/// Declares a choice between words: `Variant = "word"`.
#[macro_export]
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

        impl $crate::keys::read::ConfigValue for $name {
            fn kind() -> String {
                [$( concat!("\"", $word, "\"") ),+].join(" | ")
            }
            fn read(
                node: &$crate::keys::source::Node,
                reader: &mut $crate::keys::read::Reader,
                key: &str,
            ) -> Option<Self> {
                match &node.value {
                    $( $crate::keys::source::Value::String(s) if s == $word => Some(Self::$variant), )+
                    $crate::keys::source::Value::String(s) => {
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

/// Declares a table whose key `kind` decides which other keys it accepts: `Variant(Section) = "kind"`.
#[macro_export]
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

        impl $crate::keys::read::ConfigValue for $name {
            fn kind() -> String {
                "a table".into()
            }
            fn read(
                node: &$crate::keys::source::Node,
                reader: &mut $crate::keys::read::Reader,
                key: &str,
            ) -> Option<Self> {
                use $crate::keys::read::join;
                use $crate::keys::source::Value;
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
            fn docs(key: &str, out: &mut Vec<$crate::keys::read::KeyDoc>) {
                use $crate::keys::read::{join, KeyDoc};
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
