//! What `dpm doctor` says of the vendor's libraries for a ViALUX ALP.

use super::{Finding, State};
use std::path::Path;

/// Where systems keep libraries.
const FOLDERS: [&str; 6] = [
    "usr/lib/x86_64-linux-gnu",
    "usr/lib/aarch64-linux-gnu",
    "usr/lib64",
    "usr/lib",
    "usr/local/lib",
    "usr/local/lib64",
];

/// The ALP libraries below `root`.
pub(super) fn libraries(root: &Path) -> Finding {
    let mut found = Vec::new();
    for folder in FOLDERS {
        for number in ["51", "50", "44", "43", "42", "41"] {
            let file = format!("{folder}/libalp{number}.so");
            if root.join(&file).exists() {
                found.push(format!("/{file}"));
            }
        }
    }
    if found.is_empty() {
        let remedy = "needed only for a ViALUX ALP: install the vendor's ALP for Linux";
        return Finding::new("ALP library", State::Info, "none", remedy);
    }
    Finding::new("ALP library", State::Ok, found.join(", "), "")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn installed_libraries_are_listed() {
        let root = std::env::temp_dir().join(format!("dpm-doctor-alp-{}", std::process::id()));
        let folder = root.join("usr/lib/x86_64-linux-gnu");
        std::fs::create_dir_all(&folder).unwrap();
        assert_eq!(libraries(&root).state, State::Info);
        for name in ["libalp43.so", "libalp50.so", "libalps.so"] {
            std::fs::write(folder.join(name), "").unwrap();
        }
        let finding = libraries(&root);
        std::fs::remove_dir_all(&root).unwrap();
        let expected = "/usr/lib/x86_64-linux-gnu/libalp50.so, /usr/lib/x86_64-linux-gnu/libalp43.so";
        assert_eq!((finding.state, finding.found.as_str()), (State::Ok, expected));
    }
}
