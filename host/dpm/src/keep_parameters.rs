//! Keeps the parameters of a run for the next one: numbers in the rig file, motions in the calibration file, which the rig
//! file then names. The files that are replaced are kept beside the new ones.

use dpm_common::files::{keep_old, write_atomically};
use dpm_device::regular_file;
use dpm_rig::config::{Overrides, Purpose, RigConfig, MAX_FILE_BYTES};
use dpm_rig::parameters::desk::{Saver, Setting, ToKeep};
use dpm_rig::results::{check_known, keep, NudgeTarget, Results};
use dpm_rig::rig::Rig;
use std::io::Write;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Writes to the rig file at `path` and to its calibration file.
pub(crate) fn saver(path: PathBuf) -> Saver {
    Box::new(move |rig, kept| save(&path, rig, kept))
}

/// Saves for a run without a rig file.
pub(crate) fn no_file() -> Saver {
    Box::new(|_, _| {
        Err("the built-in demo has no rig file; copy rigs/demo.toml and run that with `dpm run`".into())
    })
}

/// Writes what is to be kept. Everything is checked before the first file is touched.
fn save(path: &Path, rig: &Rig, kept: &ToKeep) -> Result<String, String> {
    let results = motions(path, rig, kept)?;
    // A link leads to the file that is meant.
    let path = path.canonicalize().map_err(|e| format!("{}: {e}", path.display()))?;
    let mut config = rig.config.clone();
    let mut keys = kept.keys.clone();
    if let Some(results) = results.as_ref().filter(|_| config.calibration.file.is_none()) {
        // Without the entry the next run would not have what is kept.
        keys.push((["calibration", "file"], Setting::Text(name_for(results.path(), &path)?)));
        config.calibration.file = Some(results.path().to_owned());
    }
    let edit = if keys.is_empty() { None } else { Some(Edit::prepared(path, &keys)?) };
    let mut told = Vec::new();
    // The rig file last, because it must not name a file that is not there.
    if let Some(results) = results {
        told.push(results.save(&config).map_err(|e| e.to_string())?.replace('\n', " "));
    }
    if let Some(edit) = edit {
        told.push(edit.write().map_err(|e| match told.join("; ") {
            before if before.is_empty() => e,
            before => format!("{before}; but {e}"),
        })?);
    }
    Ok(told.join("; "))
}

/// How the rig file at `rig` names `file`: without a folder if both lie in the same.
fn name_for(file: &Path, rig: &Path) -> Result<String, String> {
    let folder = dpm_common::files::folder_of(file).canonicalize();
    let folder = folder.map_err(|e| format!("{}: {e}", file.display()))?;
    let name = file.file_name().ok_or_else(|| format!("{}: is no file", file.display()))?;
    let named = if rig.parent() == Some(&*folder) { PathBuf::from(name) } else { folder.join(name) };
    named.into_os_string().into_string().map_err(|_| format!("{}: its name is no text", file.display()))
}

/// The calibration file with the motions of `kept`; `None` if there are none.
fn motions(path: &Path, rig: &Rig, kept: &ToKeep) -> Result<Option<Results>, String> {
    if kept.projector.is_none() && kept.bodies.is_empty() {
        return Ok(None);
    }
    if !kept.bodies.is_empty() && rig.config.tracker.is_mock() {
        return Err(
            "the mock tracker reports the mesh itself, so no motion of a body can be kept; set it back to 0"
                .into(),
        );
    }
    let mut results = Results::open(None, path, &rig.config).map_err(|e| e.to_string())?;
    let moved = kept.projector.iter().map(|motion| (NudgeTarget::Projector, motion));
    let bodies = kept.bodies.iter().map(|(name, motion)| (NudgeTarget::Body(name.clone()), motion));
    for (what, motion) in moved.chain(bodies) {
        check_known(&results, &what).map_err(|e| e.to_string())?;
        keep(&mut results, &rig.config, &what, motion);
    }
    Ok(Some(results))
}

/// A rig file with other values that can be written.
struct Edit {
    path: PathBuf,
    text: String,
}

impl Edit {
    /// The rig file at `path` with the values of `keys`, read and checked. Nothing is written yet.
    fn prepared(path: PathBuf, keys: &[([&'static str; 2], Setting)]) -> Result<Self, String> {
        let named = |e: &dyn std::fmt::Display| format!("{}: {e}", path.display());
        let old = regular_file::read_text(&path, MAX_FILE_BYTES).map_err(|e| named(&e))?;
        let text = edited(&old, keys).map_err(|e| named(&e))?;
        // A file that needs flags beside it is no worse than before. The calibration file may be about to be written.
        let check = |text: &str| {
            let purpose = Purpose { at_rest: true, calibrates: true, ..Purpose::default() };
            let base = path.parent().unwrap_or(Path::new(""));
            RigConfig::parse_for(&path.display().to_string(), text, base, &Overrides::default(), purpose)
        };
        if let (Ok(_), Err(wrong)) = (check(&old), check(&text)) {
            return Err(format!("the rig file would not be valid any more: {wrong}"));
        }
        Ok(Self { path, text })
    }

    /// Writes it; the file before is kept.
    fn write(&self) -> Result<String, String> {
        let kept =
            keep_old(&self.path, MAX_FILE_BYTES).map_err(|e| format!("{}: {e}", self.path.display()))?;
        write_atomically(&self.path, |file| file.write_all(self.text.as_bytes()))
            .map_err(|e| e.to_string())?;
        let beside =
            kept.map_or(String::new(), |old| format!(" (the one before is kept as {})", old.display()));
        Ok(format!("written: {}{beside}", self.path.display()))
    }
}

fn value_of(setting: &Setting) -> Value {
    match setting {
        Setting::Number(n) => Value::Float(*n),
        Setting::Whole(n) => Value::Integer(*n),
        Setting::Point(p) => Value::Array(p.map(Value::Float).to_vec()),
        Setting::Text(text) => Value::String(text.clone()),
        Setting::Table(all) => {
            Value::Table(all.iter().map(|(key, v)| ((*key).to_owned(), value_of(v))).collect())
        }
    }
}

/// The text of a rig file with other values, and everything else as it was, comments included.
///
/// # Errors
/// The file has a key in a form that is not changed here; the message says what to write.
fn edited(text: &str, keys: &[([&'static str; 2], Setting)]) -> Result<String, String> {
    let mut wanted: Table = text.parse().map_err(|e| format!("{e}"))?;
    let mut now = text.to_owned();
    for ([section, key], setting) in keys {
        let value = value_of(setting);
        let by_hand = || format!("write `{key} = {value}` under [{section}] by hand");
        now = with(&now, section, key, &value).ok_or_else(by_hand)?;
        let table = wanted.entry(*section).or_insert_with(|| Value::Table(Table::new()));
        table.as_table_mut().ok_or_else(by_hand)?.insert((*key).to_owned(), value.clone());
        // The text is edited, and its meaning is checked.
        if now.parse::<Table>().ok().as_ref() != Some(&wanted) {
            return Err(by_hand());
        }
    }
    Ok(now)
}

/// The text with `key` of `section` replaced where it stands, or else below the section's heading, or else at the end.
fn with(text: &str, section: &str, key: &str, value: &Value) -> Option<String> {
    let parsed = toml::de::DeTable::parse(text).ok()?;
    let table = parsed.get_ref().get(section).and_then(|s| s.get_ref().as_table());
    if let Some(old) = table.and_then(|t| t.get(key)) {
        let span = old.span();
        return Some(format!("{}{value}{}", text.get(..span.start)?, text.get(span.end..)?));
    }
    let mut at = 0;
    for line in text.split_inclusive('\n') {
        at += line.len();
        let heading = line.split('#').next().unwrap_or_default().trim();
        if heading.strip_prefix('[').and_then(|h| h.strip_suffix(']')).map(str::trim) == Some(section) {
            let feed = if line.ends_with('\n') { "" } else { "\n" };
            return Some(format!("{}{feed}{key} = {value}\n{}", &text[..at], &text[at..]));
        }
    }
    let feed = if text.is_empty() || text.ends_with('\n') { "" } else { "\n" };
    Some(format!("{text}{feed}\n[{section}]\n{key} = {value}\n"))
}

#[cfg(test)]
mod tests;
