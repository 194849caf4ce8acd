//! Which drivers are installed although the loader can use none: its own answer does not tell.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Variables that name the manifests in place of the folders; the loader prefers the first.
const NAMED_BY: [&str; 2] = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"];
/// Where manifests lie.
const FOLDERS: [&str; 3] = ["/usr/local/share/vulkan/icd.d", "/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d"];
/// Longest manifest that is read, bytes.
const LONGEST: u64 = 65_536;
/// Most drivers that are told.
const MOST_TOLD: usize = 4;

/// The installed manifests, as `variable` and the folders of the system tell.
fn installed(variable: impl Fn(&str) -> Option<OsString>) -> Vec<PathBuf> {
    if let Some(named) = NAMED_BY.iter().find_map(|name| variable(name)) {
        return std::env::split_paths(&named).filter(|path| !path.as_os_str().is_empty()).collect();
    }
    let own = variable("HOME").map(|home| Path::new(&home).join(".local/share/vulkan/icd.d"));
    let folders = FOLDERS.iter().map(PathBuf::from).chain(own);
    let files = folders.filter_map(|folder| std::fs::read_dir(folder).ok()).flatten().flatten();
    let mut all: Vec<_> =
        files.map(|file| file.path()).filter(|p| p.extension().is_some_and(|e| e == "json")).collect();
    all.sort();
    all
}

/// The library that a manifest names; a relative path is one from the manifest's folder, and a bare name is the system's to find.
///
/// # Errors
/// Why the manifest names none.
fn library_of(manifest: &Path) -> Result<PathBuf, String> {
    let size = std::fs::metadata(manifest).map_err(|e| e.to_string())?.len();
    if size > LONGEST {
        return Err(format!("is {size} bytes long"));
    }
    let text = std::fs::read(manifest).map_err(|e| e.to_string())?;
    let json: serde_json::Value = serde_json::from_slice(&text).map_err(|e| e.to_string())?;
    let path = json["ICD"]["library_path"].as_str().ok_or("names no library")?;
    let is_bare = Path::new(path).components().count() == 1;
    Ok(if is_bare { path.into() } else { manifest.parent().unwrap_or(Path::new("/")).join(path) })
}

/// What is wrong with an installed driver.
fn fault(manifest: &Path) -> String {
    let library = match library_of(manifest) {
        Ok(library) => library,
        Err(why) => return format!("{}: {why}", manifest.display()),
    };
    // SAFETY: the loader has just opened the same library of the system; its initialisers have run.
    let opened = unsafe { libloading::Library::new(&library) };
    let is_nvidia = library.to_string_lossy().contains("nvidia");
    match opened {
        Err(e) => format!("{} of {} cannot be loaded ({e})", library.display(), manifest.display()),
        Ok(_) if is_nvidia => format!(
            "{} of {} can be loaded but does not start; without a screen it also needs the libraries of libglvnd (Debian, Ubuntu: \
             apt-get install libgl1 libegl1)",
            library.display(),
            manifest.display()
        ),
        Ok(_) => format!("{} of {} can be loaded but does not start", library.display(), manifest.display()),
    }
}

/// What is installed, for an error that says that the loader can use nothing.
pub(super) fn told() -> String {
    tell(&installed(|name| std::env::var_os(name)))
}

fn tell(manifests: &[PathBuf]) -> String {
    if manifests.is_empty() {
        return "none is installed".into();
    }
    let faults: Vec<_> = manifests.iter().take(MOST_TOLD).map(|manifest| fault(manifest)).collect();
    let more = manifests.len().saturating_sub(MOST_TOLD);
    let rest = if more > 0 { format!("; and {more} more") } else { String::new() };
    format!("{}{rest}", faults.join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn manifests_of_drivers_that_do_not_start_are_told_with_the_reason() {
        let folder = std::env::temp_dir().join(format!("dpm-manifests-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder for the test");
        let write = |name: &str, text: &str| {
            let path = folder.join(name);
            std::fs::write(&path, text).expect("a file for the test");
            path
        };
        let lost = write("lost.json", r#"{"ICD": {"library_path": "libno_such_driver.so.1"}}"#);
        let beside = write("beside.json", r#"{"ICD": {"library_path": "./libno_such_driver.so.1"}}"#);
        let broken = write("broken.json", "{");
        let empty = write("empty.json", "{}");
        let loads = write("loads.json", r#"{"ICD": {"library_path": "libc.so.6"}}"#);
        let text = tell(&[lost.clone(), broken, empty, loads, beside.clone()]);
        for part in [
            "libno_such_driver.so.1 of ",
            "cannot be loaded",
            "names no library",
            "does not start",
            "and 1 more",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(fault(&beside).starts_with(&folder.display().to_string()), "{}", fault(&beside));
        assert_eq!(tell(&[]), "none is installed");

        let named = std::env::join_paths([&lost, &beside]).expect("plain paths");
        let by = |name: &str| (name == "VK_ICD_FILENAMES").then(|| named.clone());
        assert_eq!(installed(by), [lost, beside]);
        std::fs::remove_dir_all(&folder).expect("the test's own folder");
    }
}
