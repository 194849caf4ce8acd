//! The rig files of the sources: each is accepted unchanged, and with the mocks instead of its devices.

use dpm_rig::config::{Overrides, Purpose, RigConfig};
use std::path::Path;

#[test]
fn every_rig_file_is_accepted_as_it_stands_and_simulated() {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../rigs"));
    let entries = std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    assert!(files.len() >= 3, "{files:?}");
    for file in files {
        for simulate in [false, true] {
            let purpose = Purpose { simulate, ..Purpose::default() };
            let config = RigConfig::load_for(&file, &Overrides::default(), purpose);
            let config = config.unwrap_or_else(|e| panic!("{}, simulate {simulate}: {e}", file.display()));
            assert!(!config.scene.bodies.is_empty(), "{}", file.display());
        }
    }
}
