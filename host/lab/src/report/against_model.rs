//! What was measured on a GPU beside what the model of `dpm bench --model` expects of it, for reports of any machines.

use super::folder::FolderEntry;
use super::html::PagePart;
use super::table::{Cell, Table};
use serde_json::Value;

/// Passes that trace rays. The model does not tell the camera's rays from the others.
const TRACING: [&str; 2] = ["primary", "trace"];
/// The planes on their way to the host.
const READ_BACK: &str = "readback";

const HEAD: [&str; 11] = [
    "report",
    "GPU",
    "method",
    "tracing, ms",
    "tracing of the model, ms",
    "passes over pixels, ms",
    "the passes of the model, ms",
    "read back, ms",
    "read back of the model, ms",
    "frame, ms",
    "frame of the model, ms",
];

/// A table with a row for every method of every bench report among `results`; nothing where there is none.
pub(super) fn against_model(results: &[FolderEntry]) -> Vec<PagePart> {
    let rows: Vec<Vec<Cell>> = results.iter().flat_map(rows).collect();
    if rows.is_empty() {
        return Vec::new();
    }
    let told = "The figures of the model are computed from the counted rays, lanes, bytes and barriers of the same frames, and none of them \
                was measured. A GPU that the model does not know has none. Barriers are in the model's frame, and in what was measured of \
                each pass.";
    let head = HEAD.map(str::to_owned).to_vec();
    vec![
        PagePart::Heading("Measured beside the model".into()),
        PagePart::Text(told.into()),
        PagePart::Table(Table { title: "Measured beside the model".into(), head, rows }),
    ]
}

fn rows(found: &FolderEntry) -> Vec<Vec<Cell>> {
    let list = |key: &str| found.figures.get(key).and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    let device = found.figures.get("stamp").and_then(|stamp| stamp.get("device")).and_then(Value::as_str);
    let device = device.unwrap_or("unknown");
    let modelled = list("modelled_not_measured");
    let of_method = |method: &Value| {
        let name = method.get("method").and_then(Value::as_str)?;
        let is_it = |row: &&Value| {
            let text = |key: &str| row.get(key).and_then(Value::as_str).unwrap_or_default();
            text("method") == name && is_card(device, text("gpu"))
        };
        let model = modelled.iter().find(is_it);
        let passes = method.get("passes").and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
        let sum = |wanted: fn(&str) -> bool| {
            let of = |p: &Value| Some((p.get("pass")?.as_str()?.to_owned(), p.get("ms")?.as_f64()?));
            let ms: Vec<f64> = passes.iter().filter_map(of).filter(|p| wanted(&p.0)).map(|p| p.1).collect();
            if ms.is_empty() {
                Cell::text("-")
            } else {
                milliseconds(&Value::from(ms.iter().sum::<f64>()))
            }
        };
        let of_model = |key: &str| model.and_then(|row| row.get(key)).map_or(Cell::text("-"), milliseconds);
        Some(vec![
            Cell::text(found.name.clone()),
            Cell::text(device),
            Cell::text(name),
            sum(|pass| TRACING.contains(&pass)),
            of_model("trace_ms"),
            sum(|pass| !TRACING.contains(&pass) && pass != READ_BACK),
            of_model("screen_ms"),
            sum(|pass| pass == READ_BACK),
            of_model("readback_ms"),
            method.get("gpu_ms").map_or(Cell::text("-"), milliseconds),
            of_model("frame_ms"),
        ])
    };
    list("methods").iter().filter_map(of_method).collect()
}

/// A time, or the least and the most of one.
fn milliseconds(value: &Value) -> Cell {
    let numbers: Option<Vec<f64>> = match value {
        Value::Array(list) => list.iter().map(Value::as_f64).collect(),
        one => one.as_f64().map(|ms| vec![ms]),
    };
    let Some(numbers) = numbers.filter(|numbers| !numbers.is_empty()) else { return Cell::text("-") };
    let join = |text: fn(&f64) -> String| numbers.iter().map(text).collect::<Vec<_>>().join(" to ");
    Cell { shown: join(|ms| format!("{ms:.3}")), exact: join(f64::to_string) }
}

/// Whether a Vulkan device is a card of the model, by its name: it has every word of the card's, and is a laptop's only if the card is.
fn is_card(device: &str, card: &str) -> bool {
    let words = |text: &str| text.to_lowercase().split_whitespace().map(str::to_owned).collect::<Vec<_>>();
    let (device, card) = (words(device), words(card));
    let laptop = |words: &[String]| words.iter().any(|word| word == "laptop");
    !card.is_empty() && card.iter().all(|word| device.contains(word)) && laptop(&device) == laptop(&card)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn bench(device: &str) -> FolderEntry {
        let report = json!({
            "stamp": {"device": device},
            "methods": [{"method": "dpm", "gpu_ms": 0.9, "passes": [
                {"pass": "primary", "ms": 0.15}, {"pass": "reproject", "ms": 0.06}, {"pass": "trace", "ms": 0.5},
                {"pass": "spatial", "ms": 0.09}, {"pass": "readback", "ms": 0.05}]}],
            "modelled_not_measured": [
                {"gpu": "RTX 4090", "method": "dpm", "trace_ms": [0.17, 0.23], "screen_ms": 0.18, "barriers_ms": 0.045,
                 "readback_ms": 0.09, "frame_ms": [0.49, 0.55]},
                {"gpu": "H200", "method": "full", "trace_ms": [7.0, 8.0], "screen_ms": 0.0, "readback_ms": 0.0, "frame_ms": [7.0, 8.0]},
                {"gpu": "H200", "method": "dpm", "trace_ms": [0.2, 0.28], "screen_ms": 0.04, "barriers_ms": 0.045,
                 "readback_ms": 0.09, "frame_ms": [0.38, 0.45]}],
        });
        let Value::Object(figures) = report else { unreachable!("an object") };
        FolderEntry { name: "Bench".into(), figures, text: None, written_s: 0 }
    }

    fn shown(results: &[FolderEntry]) -> Vec<Vec<String>> {
        let parts = against_model(results);
        let Some(PagePart::Table(table)) = parts.last() else { return Vec::new() };
        assert!(table.rows.iter().all(|row| row.len() == table.head.len()));
        table.rows.iter().map(|row| row.iter().map(|cell| cell.shown.clone()).collect()).collect()
    }

    #[test]
    fn a_measured_gpu_stands_beside_its_own_card() {
        let rows = shown(&[bench("NVIDIA H200"), bench("NVIDIA GeForce RTX 4090")]);
        let beside = |row: usize| rows[row][3..].join(" | ");
        assert_eq!(
            beside(0),
            "0.650 | 0.200 to 0.280 | 0.150 | 0.040 | 0.050 | 0.090 | 0.900 | 0.380 to 0.450"
        );
        assert_eq!(
            beside(1),
            "0.650 | 0.170 to 0.230 | 0.150 | 0.180 | 0.050 | 0.090 | 0.900 | 0.490 to 0.550"
        );
    }

    #[test]
    fn a_gpu_that_the_model_does_not_know_has_no_figures_of_it() {
        for device in ["llvmpipe (LLVM 15.0.6, 256 bits)", "NVIDIA GeForce RTX 4090 Laptop GPU"] {
            let rows = shown(&[bench(device)]);
            assert_eq!(rows[0][3..].join(" | "), "0.650 | - | 0.150 | - | 0.050 | - | 0.900 | -", "{device}");
        }
        assert!(is_card("NVIDIA GeForce RTX 4060 Laptop GPU", "RTX 4060 laptop"));
        assert!(is_card("AMD Radeon RX 7900 XTX (RADV NAVI31)", "RX 7900 XTX"));
        assert!(!is_card("AMD Radeon RX 7900 XT (RADV NAVI31)", "RX 7900 XTX"));
    }

    #[test]
    fn what_was_not_measured_is_no_zero() {
        let mut found = bench("NVIDIA H200");
        found.figures["methods"] = json!([{"method": "dpm", "gpu_ms": null, "passes": []}, {"wall_ms": 3.0}]);
        assert_eq!(
            shown(&[found])[0][3..].join(" | "),
            "- | 0.200 to 0.280 | - | 0.040 | - | 0.090 | - | 0.380 to 0.450"
        );
        let mut other = bench("NVIDIA H200");
        other.figures.remove("methods");
        assert!(against_model(&[other]).is_empty() && against_model(&[]).is_empty());
    }
}
