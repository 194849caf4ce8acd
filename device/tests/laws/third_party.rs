//! `THIRD-PARTY.md` held to `Cargo.lock`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

fn read(name: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..").join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Packages of other people in the lock file: those with a source.
fn locked() -> BTreeSet<(String, String)> {
    let lock = read("Cargo.lock");
    let value = |block: &str, key: &str| {
        let line = block.lines().find_map(|l| l.strip_prefix(key)?.strip_prefix(" = "))?;
        Some(line.trim_matches('"').to_owned())
    };
    let blocks = lock.split("[[package]]").skip(1).filter(|b| value(b, "source").is_some());
    blocks.map(|b| (value(b, "name").expect("a name"), value(b, "version").expect("a version"))).collect()
}

/// Name and version to licence and the programs that contain it.
fn listed() -> BTreeMap<(String, String), (String, String)> {
    let text = read("THIRD-PARTY.md");
    let rows = text.lines().skip_while(|l| !l.starts_with("|---"));
    let mut listed = BTreeMap::new();
    for row in rows.skip(1).filter(|l| l.starts_with('|')) {
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        let [name, version, licence, contained, _source] = cells[..] else { panic!("five columns: {row}") };
        let before = listed.insert((name.into(), version.into()), (licence.into(), contained.into()));
        assert!(before.is_none(), "{name} {version} stands twice");
    }
    listed
}

/// Found in use, R19: a library under the LGPL was linked statically without a word, and no list of licences existed.
#[test]
fn every_package_in_the_lock_file_is_listed_with_its_licence() {
    let listed = listed();
    let names: BTreeSet<_> = listed.keys().cloned().collect();
    let locked = locked();
    assert!(locked.len() > 100, "the lock file was not understood");
    let missing: Vec<_> = locked.difference(&names).collect();
    let too_many: Vec<_> = names.difference(&locked).collect();
    assert!(
        missing.is_empty() && too_many.is_empty(),
        "run packaging/third-party.py: missing {missing:?}, no longer there {too_many:?}"
    );
    for ((name, version), (licence, contained)) in &listed {
        assert!(!licence.is_empty(), "{name} {version} has no licence");
        // What a program contains may be passed on with it under terms that are known; another licence needs a decision, and a
        // paragraph at the head of the file.
        let known =
            ["MIT", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "ISC", "Zlib", "Unlicense", "Unicode-3.0"];
        let all = licence.replace(['(', ')'], "");
        let is_known =
            all.split(" AND ").all(|part| part.split(" OR ").any(|one| known.contains(&one.trim())));
        let is_explained = name == "serialport" && licence == "MPL-2.0";
        assert!(contained == "–" || is_known || is_explained, "{name} {version}: {licence}");
    }
}

/// The head of the file names what needs more than a notice, in the versions that are used, and how to relink.
#[test]
fn libusb_and_serialport_are_explained() {
    let text = read("THIRD-PARTY.md");
    let listed = listed();
    for package in ["libusb1-sys", "serialport"] {
        let ((_, version), (_, contained)) =
            listed.iter().find(|((name, _), _)| name == package).unwrap_or_else(|| panic!("{package}"));
        assert!(contained.contains("dpm"), "{package} is in the program");
        assert!(
            text.contains(&format!("{package} {version}"))
                || text.contains(&format!("**{package}** {version}"))
        );
    }
    for words in ["LGPL-2.1", "MPL-2.0", "libusb-1.0-0-dev", "target/release/build/libusb1-sys-"] {
        assert!(text.contains(words), "{words}");
    }
    // The command that the text tells must mean what it says.
    let host = read("host/dpm/Cargo.toml");
    assert!(host.contains("vendored-libusb = [\"dpm-device/vendored-libusb\"]"));
    let default = host.lines().find_map(|l| l.strip_prefix("default = [")?.strip_suffix(']'));
    let default: Vec<&str> = default.expect("defaults").split(", ").map(|f| f.trim_matches('"')).collect();
    let (vendored, others): (Vec<&str>, Vec<&str>) =
        default.into_iter().partition(|feature| *feature == "vendored-libusb");
    assert_eq!(vendored.len(), 1, "statically by default");
    let without = format!("--no-default-features --features {}", others.join(","));
    for file in ["THIRD-PARTY.md", "packaging/make"] {
        assert!(read(file).contains(&without), "{file} builds with {without}");
    }
    assert!(!read("Cargo.toml").contains("\"vendored\""), "the workspace must not choose for everybody");
}
