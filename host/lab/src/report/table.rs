//! The JSON of a measurement into tables: one home for what a page shows and what a CSV file holds.

use serde_json::{Map, Value};

/// A value: as people read it, and as it was measured.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cell {
    /// Rounded to five digits.
    pub shown: String,
    /// With all digits.
    pub exact: String,
}

impl Cell {
    /// A text, which is not rounded.
    pub(crate) fn text(text: impl Into<String>) -> Self {
        let text = text.into();
        Self { shown: text.clone(), exact: text }
    }

    /// A scalar, or a short list of them; `None` for what takes a table of its own, and for nothing at all.
    fn of(value: &Value) -> Option<Self> {
        match value {
            Value::Null | Value::Object(_) => None,
            Value::Bool(yes) => Some(Self::text(if *yes { "yes" } else { "no" })),
            Value::String(text) => Some(Self::text(text)),
            Value::Number(n) => {
                let shown = n.as_f64().filter(|_| n.is_f64()).map_or_else(|| n.to_string(), rounded);
                Some(Self { shown, exact: n.to_string() })
            }
            Value::Array(list) => Self::of_list(list),
        }
    }

    fn of_list(list: &[Value]) -> Option<Self> {
        let cells: Option<Vec<Self>> =
            list.iter().map(|v| Self::of(v).or_else(|| Self::of_pair(v))).collect();
        let cells = cells.filter(|cells| (1..=MOST_IN_A_CELL).contains(&cells.len()))?;
        let join = |of: fn(&Self) -> &str| cells.iter().map(of).collect::<Vec<_>>().join(", ");
        Some(Self { shown: join(|c| &c.shown), exact: join(|c| &c.exact) })
    }

    /// A name and a number in one object, as a pass and its time.
    fn of_pair(value: &Value) -> Option<Self> {
        let object = value.as_object().filter(|o| o.len() == 2)?;
        let name = object.values().find_map(Value::as_str)?;
        let number = Self::of(object.values().find(|v| v.is_number())?)?;
        Some(Self { shown: format!("{name} {}", number.shown), exact: format!("{name} {}", number.exact) })
    }
}

/// Longest list that is written into one cell.
const MOST_IN_A_CELL: usize = 24;

/// Five digits without zeros at the end.
fn rounded(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return if x == 0.0 { "0".into() } else { x.to_string() };
    }
    let decimals = (4.0 - x.abs().log10().floor()).clamp(0.0, 12.0) as usize;
    let text = format!("{x:.decimals$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

/// A table with a name.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// What it shows.
    pub title: String,
    /// Its columns.
    pub head: Vec<String>,
    /// Its rows; each has a cell for every column.
    pub rows: Vec<Vec<Cell>>,
}

impl Table {
    /// The table as CSV (RFC 4180), with all digits.
    pub fn to_csv(&self) -> String {
        let head: Vec<Cell> = self.head.iter().map(Cell::text).collect();
        let mut text = String::new();
        for row in std::iter::once(&head).chain(&self.rows) {
            let cells: Vec<String> = row.iter().map(|cell| quoted(&cell.exact)).collect();
            text += &(cells.join(",") + "\r\n");
        }
        text
    }

    /// The title as a file name: small letters, digits and minus signs.
    pub fn file_word(&self) -> String {
        let word =
            self.title.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { ' ' });
        word.collect::<String>().split_whitespace().collect::<Vec<_>>().join("-")
    }
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\r', '\n']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// Ends of keys that are units.
const UNITS: [&str; 10] = ["ms", "ns", "us", "s", "px", "hz", "mb", "m", "deg", "bytes"];

/// A key as words with its unit behind a comma: `frame_rate_hz` is `frame rate, Hz`.
pub(crate) fn words(key: &str) -> String {
    let unit = key.rsplit_once('_').filter(|(name, unit)| UNITS.contains(unit) && !name.ends_with("_per"));
    match unit {
        Some((name, unit)) => {
            let unit = match unit {
                "hz" => "Hz",
                "mb" => "MB",
                other => other,
            };
            format!("{}, {unit}", name.replace('_', " "))
        }
        None => percentile(key).unwrap_or_else(|| key.replace('_', " ")),
    }
}

/// `p999` is `99.9 %`.
fn percentile(key: &str) -> Option<String> {
    let digits = key.strip_prefix('p').filter(|d| d.len() >= 2 && d.bytes().all(|b| b.is_ascii_digit()))?;
    let (whole, rest) = digits.split_at(2);
    let whole = whole.trim_start_matches('0');
    Some(if rest.is_empty() { format!("{whole} %") } else { format!("{whole}.{rest} %") })
}

/// Columns that come first, in this order.
const FIRST: [&str; 17] = [
    "method", "name", "pass", "body", "kind", "modelled", "count", "frames", "mean", "min", "p01", "p50",
    "p90", "p99", "p999", "p9999", "max",
];

/// Keys that say nothing by themselves: batches for the noise of a comparison, and files that the page lists anyway.
const LEFT_OUT: [&str; 4] = ["batch_p50", "batch_p99", "missed_batches", "files"];

/// The tables of an object: its own scalars and all percentiles together, then one for each list or table in it. `title` names it;
/// keys in `told` are told elsewhere.
pub(crate) fn tables(title: &str, object: &Map<String, Value>, told: &[&str]) -> Vec<Table> {
    let is_told = |key: &str| told.contains(&key) || LEFT_OUT.contains(&key);
    let entries = || object.iter().filter(|(key, _)| !is_told(key));
    let figures = entries().filter_map(|(key, v)| Some(figure(key, v)?.into()));
    let mut out = vec![Table {
        title: title.to_owned(),
        head: vec!["what".into(), "value".into()],
        rows: figures.collect(),
    }];
    let spreads = entries().filter(|(_, v)| v.get("p50").is_some());
    out.extend(rows_of(&format!("{title}: distributions"), spreads.map(|(key, v)| (words(key), v))));
    for (key, value) in entries().filter(|(_, v)| v.get("p50").is_none()) {
        let name = format!("{title}: {}", words(key));
        match value {
            Value::Object(inner) if inner.values().all(Value::is_object) && !inner.is_empty() => {
                out.extend(rows_of(&name, inner.iter().map(|(key, v)| (words(key), v))));
            }
            Value::Object(inner) => out.extend(tables(&name, inner, &[])),
            Value::Array(list) if Cell::of(value).is_none() => {
                out.extend(rows_of(&name, list.iter().map(|v| (String::new(), v))));
            }
            _ => {}
        }
    }
    out.retain(|table| !table.rows.is_empty());
    out
}

/// The row of a scalar.
pub(crate) fn figure(key: &str, value: &Value) -> Option<[Cell; 2]> {
    let cell = Cell::of(value)?;
    // Columns and rows.
    let cell = if key == "raster" { Cell::text(cell.exact.replace(", ", " x ")) } else { cell };
    Some([Cell::text(words(key)), cell])
}

/// A table with a row for each object, whose columns are the keys of their scalars; without the names where they are all empty.
fn rows_of<'a>(title: &str, objects: impl Iterator<Item = (String, &'a Value)>) -> Option<Table> {
    let objects: Vec<(String, &Map<String, Value>)> =
        objects.filter_map(|(name, v)| Some((name, v.as_object()?))).collect();
    let mut keys: Vec<&str> = Vec::new();
    for (key, value) in objects.iter().flat_map(|(_, object)| object.iter()) {
        if !keys.contains(&key.as_str()) && !LEFT_OUT.contains(&key.as_str()) && Cell::of(value).is_some() {
            keys.push(key);
        }
    }
    keys.sort_by_key(|key| FIRST.iter().position(|first| first == key).unwrap_or(FIRST.len()));
    let has_names = objects.iter().any(|(name, _)| !name.is_empty());
    let name_cell = |name: &str| has_names.then(|| Cell::text(name));
    let rows = objects.iter().map(|(name, object)| {
        let cells = keys.iter().map(|key| object.get(*key).and_then(Cell::of).unwrap_or_default());
        name_cell(name).into_iter().chain(cells).collect()
    });
    let head = has_names.then(|| "what".to_owned()).into_iter().chain(keys.iter().map(|key| words(key)));
    (!keys.is_empty()).then(|| Table { title: title.to_owned(), head: head.collect(), rows: rows.collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn keys_are_words_with_units() {
        for (key, wanted) in [
            ("frame_rate_hz", "frame rate, Hz"),
            ("motion_to_light_ms", "motion to light, ms"),
            ("frames_lit", "frames lit"),
            ("mrays_per_s", "mrays per s"),
            ("p50", "50 %"),
            ("p999", "99.9 %"),
            ("p01", "1 %"),
            ("planes", "planes"),
        ] {
            assert_eq!(words(key), wanted);
        }
    }

    #[test]
    fn figures_are_rounded_for_people_and_exact_in_files() {
        for (x, wanted) in
            [(0.000_290_123, "0.00029012"), (947.0, "947"), (1_783_424.618, "1783425"), (0.5, "0.5")]
        {
            assert_eq!(rounded(x), wanted);
        }
        let cell = Cell::of(&json!(0.123_456_789)).unwrap();
        assert_eq!((cell.shown.as_str(), cell.exact.as_str()), ("0.12346", "0.123456789"));
        let table = Table {
            title: "A: b, c".into(),
            head: vec!["x".into(), "y, z".into()],
            rows: vec![vec![cell, Cell::text("say \"no\"")]],
        };
        assert_eq!(table.to_csv(), "x,\"y, z\"\r\n0.123456789,\"say \"\"no\"\"\"\r\n");
        assert_eq!(table.file_word(), "a-b-c");
    }

    #[test]
    fn every_figure_of_a_report_is_in_a_table() {
        let report = json!({
            "slots": 60, "gone": null, "files": ["a"], "raster": [4, 3],
            "late_ms": {"max": 3.0, "p50": 1.0}, "error_px": {"p50": 0.5},
            "stages_ms": {"plan": {"p99": 2, "p50": 1}, "pack": {"p50": 7}},
            "causes": {"link": 8},
            "methods": [{"wall_ms": 4.5, "method": "full", "passes": [{"pass": "trace", "ms": 2.5}]}],
        });
        let all = tables("Run", report.as_object().unwrap(), &["slots"]);
        let text = |t: &Table| {
            let row = |r: &Vec<Cell>| r.iter().map(|c| c.shown.clone()).collect::<Vec<_>>().join("|");
            format!(
                "{}: {}: {}",
                t.title,
                t.head.join("|"),
                t.rows.iter().map(row).collect::<Vec<_>>().join("; ")
            )
        };
        let told: Vec<String> = all.iter().map(text).collect();
        assert_eq!(
            told,
            [
                "Run: what|value: raster|4 x 3",
                "Run: distributions: what|50 %|max: error, px|0.5|; late, ms|1|3",
                "Run: causes: what|value: link|8",
                "Run: methods: method|passes|wall, ms: full|trace 2.5|4.5",
                "Run: stages, ms: what|50 %|99 %: pack|7|; plan|1|2",
            ]
        );
    }
}
