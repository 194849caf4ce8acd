//! The rig files of the sources: each is accepted unchanged, and with the mocks instead of its devices.

use dpm_rig::config::{Overrides, Purpose, RigConfig};
use std::path::Path;

#[test]
fn every_rig_file_is_accepted_as_it_stands_and_simulated() {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../rigs"));
    let files_of = |folder: &Path| -> Vec<_> {
        let entries = std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
        let paths = entries.map(|entry| entry.unwrap().path());
        paths.filter(|path| path.extension().is_some_and(|e| e == "toml")).collect()
    };
    let files = [files_of(folder), files_of(&folder.join("groups"))].concat();
    assert!(files.len() >= 20, "{files:?}");
    for file in files {
        for simulate in [false, true] {
            let purpose = Purpose { simulate, ..Purpose::default() };
            let config = RigConfig::load_for(&file, &Overrides::default(), purpose);
            let config = config.unwrap_or_else(|e| panic!("{}, simulate {simulate}: {e}", file.display()));
            assert!(!config.scene.bodies.is_empty(), "{}", file.display());
        }
    }
}

/// One rig file moves from projector to projector by `[projector.backend]` and the projector's width, height, frame rate and
/// planes: nothing else in it has to change.
#[test]
fn a_rig_file_moves_from_projector_to_projector() {
    let at = |width: u32, height: u32, rate: &str, planes: u32, backend: &str| {
        let flags = [
            format!("projector.width={width}"),
            format!("projector.height={height}"),
            format!("projector.frame_rate={rate:?}"),
            format!("projector.planes={planes}"),
            format!("projector.backend={backend}"),
            "real_time.pace=\"real\"".into(),
        ];
        let config = RigConfig::demo(&Overrides { variables: vec![], flags: flags.to_vec() });
        config.unwrap_or_else(|e| panic!("{backend}: {e}"))
    };
    let behind = |encoding: &str| {
        at(
            1920,
            1080,
            "60",
            24,
            &format!("{{kind=\"display\",encoding={encoding:?},dlpc900={{panel=\"dlp6500\"}}}}"),
        )
    };
    let rigs = [
        at(1024, 768, "947", 24, "{kind=\"mock\"}"),
        at(1024, 768, "947", 24, "{kind=\"usb\"}"),
        at(1024, 768, "60", 24, "{kind=\"window\"}"),
        at(1920, 1080, "60", 24, "{kind=\"display\"}"),
        at(1024, 768, "80", 8, "{kind=\"alp\",plane_times=\"binary\"}"),
        at(1920, 1080, "60", 24, "{kind=\"dlpc900\"}"),
        behind("rgb8"),
        behind("planes24"),
        behind("binary24"),
        behind("mono8x3"),
        behind("rgb4x2"),
    ];
    for rig in &rigs {
        // All of them can show full white.
        assert_eq!(rig.projector.full_light(), 255, "{:?}", rig.projector.backend);
        assert_eq!(rig.projector.schedule().len(), rig.projector.planes as usize);
    }
}
