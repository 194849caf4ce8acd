//! Kinds of which a program can have more: rows of a table, each with keys of its own. `kind` in the rig file names a row.

use super::read::{join, ConfigValue, KeyDoc, KeyReader};
use super::source::{Entry, SourceNode, Value};
use std::any::Any;
use std::collections::BTreeMap;
use std::fmt::{self, Debug};
use std::ops::Deref;
use std::sync::{Arc, PoisonError, RwLock};

/// A table of declared keys. [`section!`](crate::section) implements it.
pub trait Section: Clone + Debug + Default + PartialEq + Send + Sync + 'static {
    /// Names of the section's keys.
    const KEYS: &'static [&'static str];

    /// The defaults, replaced by the keys that are present. Ignores `kind` and keys of other sections.
    fn read_keys(table: &BTreeMap<String, Entry>, reader: &mut KeyReader, section: &str) -> Self;

    /// The section's keys for the manual.
    fn document(section: &str, out: &mut Vec<KeyDoc>);
}

/// A section behind a pointer: the values of a kind's keys.
pub trait KeyValues: Any + Debug + Send + Sync {
    /// The section itself.
    fn as_any(&self) -> &dyn Any;

    /// True for the same section with the same values.
    fn is_same(&self, other: &dyn Any) -> bool;
}

impl<S: Section> KeyValues for S {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn is_same(&self, other: &dyn Any) -> bool {
        other.downcast_ref::<S>() == Some(self)
    }
}

/// A kind as it stands in the rig file and in the manual.
#[derive(Clone, Copy, Debug)]
pub struct KindWord {
    /// The value of `kind`.
    pub word: &'static str,
    /// What it is: the end of a sentence, for the manual.
    pub about: &'static str,
    /// Names of its keys.
    pub keys: &'static [&'static str],
    /// Adds its keys to the manual, as keys of the given section.
    pub document: fn(&str, &mut Vec<KeyDoc>),
}

impl KindWord {
    /// The kind `word` with the keys of `S`.
    pub const fn of<S: Section>(word: &'static str, about: &'static str) -> Self {
        Self { word, about, keys: S::KEYS, document: S::document }
    }
}

/// Reads which of `kinds` the table `node` has, and refuses the keys of other kinds. Without the key `kind` it is `default`.
/// Returns the index of the kind, and the table.
pub fn read_kind<'n>(
    kinds: &[KindWord],
    default: &str,
    node: &'n SourceNode,
    reader: &mut KeyReader,
    key: &str,
) -> Option<(usize, &'n BTreeMap<String, Entry>)> {
    let table = reader.table(node, key)?;
    let index_of = |word: &str| kinds.iter().position(|kind| kind.word == word);
    let index = match table.get("kind") {
        None => index_of(default)?,
        Some(entry) => {
            reader.mark(&join(key, "kind"), &entry.node.origin);
            let (named, shown) = match &entry.node.value {
                Value::String(s) => (index_of(s), format!("{s:?}")),
                other => (None, other.kind().to_string()),
            };
            let Some(index) = named else {
                let quoted: Vec<String> = kinds.iter().map(|kind| format!("{:?}", kind.word)).collect();
                let problem = format!("is {shown}, must be one of {}", quoted.join(" | "));
                reader.refuse(&entry.node.origin, &join(key, "kind"), problem, "");
                return None;
            };
            index
        }
    };
    let KindWord { word, keys: known, .. } = kinds[index];
    for (name, entry) in table {
        if name == "kind" || known.contains(&name.as_str()) {
            continue;
        }
        let owners = kinds.iter().filter(|kind| kind.keys.contains(&name.as_str()));
        let owners: Vec<&str> = owners.map(|kind| kind.word).collect();
        if owners.is_empty() {
            let all: Vec<&str> = known.iter().copied().chain(["kind"]).collect();
            let only = BTreeMap::from([(name.clone(), entry.clone())]);
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
    Some((index, table))
}

/// The manual's rows of `kinds`: the key `kind` itself, and the keys of each.
pub fn document_kinds(kinds: &[KindWord], default: &str, key: &str, out: &mut Vec<KeyDoc>) {
    let quoted: Vec<String> = kinds.iter().map(|kind| format!("{:?}", kind.word)).collect();
    let about: Vec<String> =
        kinds.iter().map(|kind| format!("`{}`: {}", kind.word, kind.about.trim())).collect();
    out.push(KeyDoc {
        key: join(key, "kind"),
        kind: quoted.join(" | "),
        unit: "",
        default: format!("{default:?}"),
        range: String::new(),
        doc: about.join(" "),
    });
    for kind in kinds {
        (kind.document)(&format!("{key}({})", kind.word), out);
    }
}

/// The rows that a crate brings, and those that other crates add before anything is read.
pub struct Registry<R: 'static> {
    own: &'static [&'static R],
    added: RwLock<Vec<&'static R>>,
}

impl<R: Row> Registry<R> {
    /// A table of `own` rows; the first is the default.
    pub const fn new(own: &'static [&'static R]) -> Self {
        Self { own, added: RwLock::new(Vec::new()) }
    }

    /// Adds a row. One that is there already stays as it is.
    pub fn add(&self, row: &'static R) {
        let mut added = self.added.write().unwrap_or_else(PoisonError::into_inner);
        if !self.own.iter().chain(added.iter()).any(|known| std::ptr::eq(*known, row)) {
            added.push(row);
        }
    }

    /// All rows: those of the crate, then the others as they were added.
    pub fn all(&self) -> Vec<&'static R> {
        let added = self.added.read().unwrap_or_else(PoisonError::into_inner);
        self.own.iter().chain(added.iter()).copied().collect()
    }

    /// The row that stands for a missing `kind`.
    ///
    /// # Panics
    /// The table has no row of its own.
    pub fn first(&self) -> &'static R {
        self.own[0]
    }
}

/// A row of a table of kinds.
pub trait Row: Sized + Sync + 'static {
    /// What the program asks of the keys of any kind.
    type Keys: KeyValues + ?Sized;

    /// The table.
    fn registry() -> &'static Registry<Self>;

    /// Its word and keys in the rig file.
    fn word(&self) -> &KindWord;

    /// True for a stand-in in this process, of software.
    fn is_mock(&self) -> bool;

    /// Reads its keys.
    fn read(&self, table: &BTreeMap<String, Entry>, reader: &mut KeyReader, section: &str)
        -> Arc<Self::Keys>;
}

/// A table of the rig file that names a kind: the row, and the values of its keys, to which it dereferences.
pub struct OfKind<R: Row> {
    kind: &'static R,
    keys: Arc<R::Keys>,
}

impl<R: Row> OfKind<R> {
    /// `kind` with its defaults.
    pub fn plain(kind: &'static R) -> Self {
        Self { kind, keys: kind.read(&BTreeMap::new(), &mut KeyReader::default(), "") }
    }

    /// `kind` with `keys`, which are its own.
    pub fn new(kind: &'static R, keys: Arc<R::Keys>) -> Self {
        Self { kind, keys }
    }

    /// The row.
    pub fn kind(&self) -> &'static R {
        self.kind
    }

    /// Its word in the rig file and in reports.
    pub fn word(&self) -> &'static str {
        self.kind.word().word
    }

    /// The keys of the kind that has `K`; `None` for another kind.
    pub fn keys<K: Section>(&self) -> Option<&K> {
        self.keys.as_any().downcast_ref()
    }

    /// True for a stand-in in this process.
    pub fn is_mock(&self) -> bool {
        self.kind.is_mock()
    }
}

impl<R: Row> Clone for OfKind<R> {
    fn clone(&self) -> Self {
        Self { kind: self.kind, keys: self.keys.clone() }
    }
}

impl<R: Row> Deref for OfKind<R> {
    type Target = R::Keys;

    fn deref(&self) -> &Self::Target {
        &self.keys
    }
}

impl<R: Row> Debug for OfKind<R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.keys.fmt(f)
    }
}

impl<R: Row> PartialEq for OfKind<R> {
    fn eq(&self, other: &Self) -> bool {
        self.keys.is_same(other.keys.as_any())
    }
}

impl<R: Row> Default for OfKind<R> {
    fn default() -> Self {
        Self::plain(R::registry().first())
    }
}

fn words<R: Row>() -> (Vec<&'static R>, Vec<KindWord>, &'static str) {
    let kinds = R::registry().all();
    let words = kinds.iter().map(|kind| *kind.word()).collect();
    (kinds, words, R::registry().first().word().word)
}

impl<R: Row> ConfigValue for OfKind<R> {
    fn kind() -> String {
        "a table".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let (kinds, words, default) = words::<R>();
        let (index, table) = read_kind(&words, default, node, reader, key)?;
        let kind = kinds[index];
        Some(Self { kind, keys: kind.read(table, reader, key) })
    }

    fn show(&self) -> String {
        format!("{{ kind = {:?} }}", self.word())
    }

    fn docs(key: &str, out: &mut Vec<KeyDoc>) {
        let (_, words, default) = words::<R>();
        document_kinds(&words, default, key, out);
    }
}
