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

        impl $crate::keys::rows::Section for $section {
            const KEYS: &'static [&'static str] = &[$( stringify!($name) ),*];

            fn read_keys(
                table: &std::collections::BTreeMap<String, $crate::keys::source::Entry>,
                reader: &mut $crate::keys::read::KeyReader,
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

            fn document(section: &str, out: &mut Vec<$crate::keys::read::KeyDoc>) {
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
                node: &$crate::keys::source::SourceNode,
                reader: &mut $crate::keys::read::KeyReader,
                key: &str,
            ) -> Option<Self> {
                let table = reader.table(node, key)?;
                use $crate::keys::rows::Section;
                reader.unknown_keys(table, key, Self::KEYS);
                Some(Self::read_keys(table, reader, key))
            }
            fn show(&self) -> String {
                "{}".into()
            }
            fn docs(key: &str, out: &mut Vec<$crate::keys::read::KeyDoc>) {
                <Self as $crate::keys::rows::Section>::document(key, out);
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
                node: &$crate::keys::source::SourceNode,
                reader: &mut $crate::keys::read::KeyReader,
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
            const ROWS: &'static [$crate::keys::rows::KindWord] = &[$(
                $crate::keys::rows::KindWord::of::<$section>($word, concat!($($doc),+)),
            )+];

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
                node: &$crate::keys::source::SourceNode,
                reader: &mut $crate::keys::read::KeyReader,
                key: &str,
            ) -> Option<Self> {
                use $crate::keys::rows::{read_kind, Section};
                let default = Self::default();
                let (index, table) = read_kind(Self::ROWS, default.word(), node, reader, key)?;
                match Self::ROWS[index].word {
                    $( $word => Some(Self::$variant(<$section>::read_keys(table, reader, key))), )+
                    _ => None,
                }
            }
            fn show(&self) -> String {
                format!("{{ kind = {:?} }}", self.word())
            }
            fn docs(key: &str, out: &mut Vec<$crate::keys::read::KeyDoc>) {
                $crate::keys::rows::document_kinds(Self::ROWS, Self::default().word(), key, out);
            }
        }
    };
}
