//! Parses JSON text into a tree of bounded size and depth, with typed access whose error messages name the place.

use std::cell::Cell;

use serde::de::{DeserializeSeed, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};

use super::super::SceneError;

/// Parses `text`. Refused: more than `max_values` values, nesting beyond 128 levels, a key twice in one object, text after the end.
pub(super) fn parse(text: &[u8], max_values: u64) -> Result<Value, SceneError> {
    let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
    let left = Cell::new(max_values);
    let mut parser = serde_json::Deserializer::from_slice(text);
    let value = Tree { left: &left }.deserialize(&mut parser).and_then(|v| parser.end().map(|()| v));
    value.map_err(|e| {
        if left.get() == 0 {
            return SceneError::TooLarge {
                what: "the number of JSON values".into(),
                found: max_values + 1,
                limit: max_values,
                remedy: "keep bulk data in buffers",
            };
        }
        let text = e.to_string();
        if text.starts_with("recursion limit") {
            SceneError::broken("JSON", format!("nested deeper than 128 levels ({text})"))
        } else {
            SceneError::broken("JSON", text)
        }
    })
}

struct Tree<'a> {
    left: &'a Cell<u64>,
}

impl<'de> DeserializeSeed<'de> for Tree<'_> {
    type Value = Value;
    fn deserialize<D: serde::Deserializer<'de>>(self, parser: D) -> Result<Value, D::Error> {
        let left = self.left.get();
        if left == 0 {
            return Err(D::Error::custom("too many values"));
        }
        self.left.set(left - 1);
        parser.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Tree<'_> {
    type Value = Value;
    fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str("JSON")
    }
    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }
    fn visit_bool<E>(self, v: bool) -> Result<Value, E> {
        Ok(v.into())
    }
    fn visit_u64<E>(self, v: u64) -> Result<Value, E> {
        Ok(v.into())
    }
    fn visit_i64<E>(self, v: i64) -> Result<Value, E> {
        Ok(v.into())
    }
    fn visit_f64<E>(self, v: f64) -> Result<Value, E> {
        Ok(v.into())
    }
    fn visit_str<E>(self, v: &str) -> Result<Value, E> {
        Ok(v.into())
    }
    fn visit_string<E>(self, v: String) -> Result<Value, E> {
        Ok(v.into())
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Value, A::Error> {
        let mut out = vec![];
        while let Some(v) = list.next_element_seed(Tree { left: self.left })? {
            out.push(v);
        }
        Ok(Value::Array(out))
    }
    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> Result<Value, A::Error> {
        let mut out = Map::new();
        while let Some(key) = object.next_key::<String>()? {
            let value = object.next_value_seed(Tree { left: self.left })?;
            if out.contains_key(&key) {
                return Err(A::Error::custom(format!("the key '{key}' appears twice in one object")));
            }
            out.insert(key, value);
        }
        Ok(Value::Object(out))
    }
}

/// A JSON object with its name in messages: "accessor 3", "material 1 'glass'".
#[derive(Clone)]
pub(super) struct Item<'a> {
    map: &'a Map<String, Value>,
    /// Name for messages.
    pub name: String,
}

impl<'a> Item<'a> {
    /// Interprets `value` as an object called `name`.
    pub(super) fn new(value: &'a Value, name: String) -> Result<Self, SceneError> {
        match value {
            Value::Object(map) => Ok(Self { map, name }),
            _ => Err(SceneError::broken(name, "must be a JSON object")),
        }
    }

    /// An error at this object.
    pub(super) fn error(&self, problem: impl Into<String>) -> SceneError {
        SceneError::broken(self.name.clone(), problem)
    }

    /// The raw value, if present.
    pub(super) fn get(&self, key: &str) -> Option<&'a Value> {
        self.map.get(key)
    }

    /// Keys of the object.
    pub(super) fn keys(&self) -> impl Iterator<Item = &'a String> {
        self.map.keys()
    }

    /// The object as JSON text.
    #[cfg(feature = "compressed")]
    pub(super) fn to_json(&self) -> String {
        serde_json::to_string(self.map).unwrap_or_default()
    }

    /// A nested object.
    pub(super) fn object(&self, key: &str) -> Result<Option<Item<'a>>, SceneError> {
        self.get(key).map(|v| Item::new(v, format!("{}, {key}", self.name))).transpose()
    }

    /// A nested object inside `extensions`.
    pub(super) fn extension(&self, key: &str) -> Result<Option<Item<'a>>, SceneError> {
        match self.object("extensions")? {
            Some(all) => all.get(key).map(|v| Item::new(v, format!("{}, {key}", self.name))).transpose(),
            None => Ok(None),
        }
    }

    /// The objects of a list; none if the key is absent. Each is called `kind` and its index, with its "name" if it has
    /// one.
    pub(super) fn list(&self, key: &str, kind: &str, limit: u64) -> Result<Vec<Item<'a>>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(vec![]) };
        let Value::Array(values) = value else { return Err(self.error(format!("'{key}' must be a list"))) };
        SceneError::check_limit(
            &format!("the number of {key}"),
            values.len() as u64,
            limit,
            "split or simplify the scene",
        )?;
        values.iter().enumerate().map(|(i, v)| Item::new(v, label(kind, i, v))).collect()
    }

    /// A non-negative integer.
    pub(super) fn whole(&self, key: &str) -> Result<Option<u64>, SceneError> {
        self.get(key)
            .map(|v| {
                v.as_u64().ok_or_else(|| {
                    self.error(format!("'{key}' is {}, not a whole number from 0", shorten(&v.to_string())))
                })
            })
            .transpose()
    }

    /// An index that must point into a list of `count` things called `kind`.
    pub(super) fn index(&self, key: &str, count: usize, kind: &str) -> Result<Option<usize>, SceneError> {
        match self.whole(key)? {
            Some(i) if i >= count as u64 => {
                Err(self.error(format!("'{key}' points at {kind} {i}, but the file has {count}")))
            }
            other => Ok(other.map(|i| i as usize)),
        }
    }

    /// Indices, each of which must point into a list of `count` things called `kind`.
    pub(super) fn indices(&self, key: &str, count: usize, kind: &str) -> Result<Vec<usize>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(vec![]) };
        let Value::Array(values) = value else { return Err(self.error(format!("'{key}' must be a list"))) };
        let check = |v: &Value| match v.as_u64() {
            Some(i) if i < count as u64 => Ok(i as usize),
            _ => Err(self.error(format!(
                "'{key}' points at {kind} {}, but the file has {count}",
                shorten(&v.to_string())
            ))),
        };
        values.iter().map(check).collect()
    }

    /// A number that stays finite in f32.
    pub(super) fn number(&self, key: &str) -> Result<Option<f32>, SceneError> {
        self.get(key).map(|v| self.finite(key, v)).transpose()
    }

    /// Exactly `N` numbers that stay finite in f32.
    pub(super) fn numbers<const N: usize>(&self, key: &str) -> Result<Option<[f32; N]>, SceneError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let list = value.as_array().map_or(&[][..], |v| v);
        let Ok(values) = <&[Value; N]>::try_from(list) else {
            return Err(self.error(format!("'{key}' must be a list of {N} numbers")));
        };
        let mut out = [0.0; N];
        for (o, v) in out.iter_mut().zip(values) {
            *o = self.finite(key, v)?;
        }
        Ok(Some(out))
    }

    fn finite(&self, key: &str, v: &Value) -> Result<f32, SceneError> {
        let number = v.as_f64().map(|x| x as f32).filter(|x| x.is_finite());
        number.ok_or_else(|| {
            self.error(format!("'{key}' holds {}, not a finite 32-bit number", shorten(&v.to_string())))
        })
    }

    /// A string.
    pub(super) fn text(&self, key: &str) -> Result<Option<&'a str>, SceneError> {
        self.get(key)
            .map(|v| v.as_str().ok_or_else(|| self.error(format!("'{key}' must be a string"))))
            .transpose()
    }

    /// True or false.
    pub(super) fn flag(&self, key: &str) -> Result<bool, SceneError> {
        self.get(key).map_or(Ok(false), |v| {
            v.as_bool().ok_or_else(|| self.error(format!("'{key}' must be true or false")))
        })
    }
}

/// What messages call entry `i` of a list: `kind` and its index, with its "name" if it has one.
pub(super) fn label(kind: &str, i: usize, value: &Value) -> String {
    let name = value.get("name").and_then(Value::as_str);
    name.map_or_else(|| format!("{kind} {i}"), |name| format!("{kind} {i} '{}'", shorten(name)))
}

/// Text from a file, shortened to one line for a message.
pub(crate) fn shorten(text: &str) -> String {
    shorten_to(text, 60)
}

/// The same with at most so many characters of the text.
pub(super) fn shorten_to(text: &str, most: usize) -> String {
    let mut out: String = text.chars().take(most).map(|c| if c.is_control() { '?' } else { c }).collect();
    if text.chars().nth(most).is_some() {
        out.push_str("...");
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nesting_size_and_repeated_keys_are_bounded() {
        let deep = "[".repeat(100_000);
        assert!(parse(deep.as_bytes(), 1000).unwrap_err().to_string().contains("128 levels"));
        let wide = format!("[{}1]", "1,".repeat(1000));
        assert!(parse(wide.as_bytes(), 1000).unwrap_err().to_string().contains("JSON values"));
        assert!(parse(wide.as_bytes(), 1002).is_ok());
        assert!(parse(br#"{"a":1,"b":{"c":1,"c":2}}"#, 10)
            .unwrap_err()
            .to_string()
            .contains("'c' appears twice"));
        assert!(parse(b"{\"a\":\"\xff\"}", 10).is_err());
        assert!(parse(b"{} x", 10).is_err());
        assert!(parse(b"[1e400]", 10).is_err());
    }

    #[test]
    fn parsing_agrees_with_serde_json() {
        let text = br#"{"a":[1,-2,3.5,null,true,"x"],"b":{"c":{}}}"#;
        assert_eq!(parse(text, 100).unwrap(), serde_json::from_slice::<Value>(text).unwrap());
    }
}
