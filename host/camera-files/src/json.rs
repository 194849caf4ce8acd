//! Reads OpenCV's JSON, which is not quite JSON: it has comments, `.Nan` and `.Inf`.

use super::entries::{inner, number, Entries, FileEntry, MatrixParts};
use super::StorageError;

/// Deepest nesting that is read.
const DEEPEST: usize = 64;

enum JsonValue<'a> {
    /// A number, `true`, `null`, `.Nan`: whatever has no quotes.
    Word(&'a str),
    Text(String),
    List(Vec<JsonValue<'a>>),
    Map(Vec<(String, JsonValue<'a>)>),
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Parser<'a> {
    fn wrong<T>(&self, what: impl Into<String>) -> Result<T, StorageError> {
        let line = self.text[..self.at].matches('\n').count() + 1;
        Err(StorageError::Syntax { form: "JSON", line, what: what.into() })
    }

    fn rest(&self) -> &'a str {
        &self.text[self.at..]
    }

    /// Skips white space and comments, and returns the next character.
    fn peek(&mut self) -> Option<char> {
        loop {
            let rest = self.rest();
            let trimmed = rest.trim_start();
            self.at += rest.len() - trimmed.len();
            let comment = [("//", "\n"), ("/*", "*/")].iter().find(|(start, _)| trimmed.starts_with(start));
            let Some((_, end)) = comment else { return trimmed.chars().next() };
            self.at += trimmed[2..].find(end).map_or(trimmed.len(), |i| i + 2 + end.len());
        }
    }

    fn expect(&mut self, what: char) -> Result<(), StorageError> {
        if self.peek() == Some(what) {
            self.at += 1;
            return Ok(());
        }
        self.wrong(format!("{what:?} is missing"))
    }

    /// After a member of a list or a map: true if another follows.
    fn more(&mut self, end: char) -> Result<bool, StorageError> {
        match self.peek() {
            Some(',') => {
                self.at += 1;
                // A comma before the end is forgiven.
                Ok(self.peek() != Some(end))
            }
            Some(c) if c == end => Ok(false),
            _ => self.wrong(format!("',' or {end:?} is missing")),
        }
    }

    fn value(&mut self, depth: usize) -> Result<JsonValue<'a>, StorageError> {
        if depth == DEEPEST {
            return self.wrong(format!("values are nested more than {DEEPEST} deep"));
        }
        match self.peek() {
            None => self.wrong("the text ends within a value"),
            Some('"') => Ok(JsonValue::Text(self.string()?)),
            Some('[') => {
                self.at += 1;
                let mut list = Vec::new();
                let mut go = self.peek() != Some(']');
                while go {
                    list.push(self.value(depth + 1)?);
                    go = self.more(']')?;
                }
                self.expect(']')?;
                Ok(JsonValue::List(list))
            }
            Some('{') => {
                self.at += 1;
                let mut map = Vec::new();
                let mut go = self.peek() != Some('}');
                while go {
                    let key = self.key()?;
                    self.expect(':')?;
                    map.push((key, self.value(depth + 1)?));
                    go = self.more('}')?;
                }
                self.expect('}')?;
                Ok(JsonValue::Map(map))
            }
            Some(_) => {
                let rest = self.rest();
                let is_end = |c: char| c.is_whitespace() || ",]}:\"[{/".contains(c);
                let length = rest.find(is_end).unwrap_or(rest.len());
                if length == 0 {
                    return self.wrong("a value is missing");
                }
                self.at += length;
                Ok(JsonValue::Word(&rest[..length]))
            }
        }
    }

    /// The name of a member of a map; in YAML it has no quotes.
    fn key(&mut self) -> Result<String, StorageError> {
        match self.peek() {
            Some(c) if c.is_alphabetic() || c == '_' => {
                let rest = self.rest();
                let length = rest.find(|c: char| ":,{}[]\"\n".contains(c)).unwrap_or(rest.len());
                self.at += length;
                Ok(rest[..length].trim_end().into())
            }
            _ => self.string(),
        }
    }

    fn string(&mut self) -> Result<String, StorageError> {
        self.expect('"')?;
        let mut out = String::new();
        let mut chars = self.rest().char_indices();
        while let Some((i, c)) = chars.next() {
            match c {
                '"' => {
                    self.at += i + 1;
                    return Ok(out);
                }
                // No name or word that matters has an escaped character: it is kept as it is.
                '\\' => out.extend(chars.next().map(|(_, escaped)| escaped)),
                _ => out.push(c),
            }
        }
        self.wrong("a string does not end")
    }
}

/// Adds the map in braces at the start of `text`, as YAML also has them; gives its length.
pub(super) fn add_map(
    found: &mut Entries,
    section: &str,
    name: &str,
    text: &str,
) -> Result<usize, StorageError> {
    let mut parser = Parser { text, at: 0 };
    let value = parser.value(0)?;
    add(found, section, name, &value)?;
    Ok(parser.at)
}

/// Everything in a text.
pub(super) fn entries(text: &str) -> Result<Entries, StorageError> {
    let mut parser = Parser { text, at: 0 };
    let value = parser.value(0)?;
    if parser.peek().is_some() {
        return parser.wrong("something follows the end");
    }
    let mut found = Entries::default();
    add(&mut found, "", "", &value)?;
    Ok(found)
}

fn add(found: &mut Entries, section: &str, name: &str, value: &JsonValue) -> Result<(), StorageError> {
    match value {
        JsonValue::Word(word) => found.add(section, name, Entries::word(word)),
        JsonValue::Text(text) => found.add(section, name, FileEntry::Text(text.clone())),
        JsonValue::List(list) => match rows(list) {
            Some(rows) => found.add(section, name, Entries::list(rows)),
            None => {
                let inside = inner(section, name)?;
                for (i, value) in list.iter().enumerate() {
                    match value {
                        JsonValue::Map(_) | JsonValue::List(_) => add(found, &inside, &i.to_string(), value)?,
                        JsonValue::Word(_) | JsonValue::Text(_) => found.add(section, name, FileEntry::Other),
                    }
                }
            }
        },
        JsonValue::Map(map) => match matrix(name, map)? {
            Some(matrix) => found.add(section, name, FileEntry::Matrix(matrix)),
            None => {
                let inside = inner(section, name)?;
                map.iter().try_for_each(|(key, v)| add(found, &inside, key, v))?;
            }
        },
    }
    Ok(())
}

/// The matrix that a map describes, if it describes one.
fn matrix(name: &str, map: &[(String, JsonValue)]) -> Result<Option<super::Matrix>, StorageError> {
    let get = |key: &str| map.iter().find(|(k, _)| k == key).map(|(_, v)| v);
    let word = |key: &str| match get(key) {
        Some(JsonValue::Word(word)) => Some(*word),
        Some(JsonValue::Text(text)) => Some(text.as_str()),
        _ => None,
    };
    let tagged = word("type_id") == Some("opencv-matrix");
    if !tagged && (get("rows").is_none() || get("cols").is_none() || get("data").is_none()) {
        return Ok(None);
    }
    let parts = MatrixParts { rows: word("rows"), columns: word("cols"), kind: word("dt") };
    let Some(JsonValue::List(data)) = get("data") else {
        return Err(StorageError::matrix(
            name,
            if get("data").is_some() { "data is not a list" } else { "no data" },
        ));
    };
    let mut numbers = Vec::with_capacity(data.len());
    for value in data {
        match value {
            JsonValue::Word(word) => match number(word) {
                Some(value) => numbers.push(value),
                None => return Err(StorageError::matrix(name, format!("{word:?} is not a number"))),
            },
            _ => return Err(StorageError::matrix(name, "data holds something that is not a number")),
        }
    }
    parts.matrix_of(name, numbers).map(Some)
}

/// The numbers of a list, or of a list of lists; `None` if it holds anything else.
fn rows(list: &[JsonValue]) -> Option<Vec<Vec<f64>>> {
    let word = |v: &JsonValue| if let JsonValue::Word(w) = v { number(w) } else { None };
    if let Some(row) = list.iter().map(word).collect::<Option<Vec<f64>>>() {
        return Some(vec![row]);
    }
    let row = |v: &JsonValue| if let JsonValue::List(l) = v { l.iter().map(word).collect() } else { None };
    list.iter().map(row).collect()
}
