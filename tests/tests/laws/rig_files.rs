//! The rig files of the sources: each is accepted unchanged, and with the mocks instead of its devices.

use dpm_rig::config::{Overrides, Purpose, RigConfig};
use std::path::Path;

#[test]
fn every_rig_file_is_accepted_as_it_stands_and_simulated() {
    dpm::satellites::register();
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
    dpm::satellites::register();
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

#[test]
fn the_manual_is_up_to_date() {
    dpm::satellites::register();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/CONFIG.md");
    let manual = RigConfig::manual();
    if std::env::var_os("DPM_UPDATE_MANUAL").is_some() {
        std::fs::write(&path, &manual).unwrap();
    }
    let written = std::fs::read_to_string(&path).unwrap();
    assert!(
        written == manual,
        "docs/CONFIG.md is stale: DPM_UPDATE_MANUAL=1 cargo test -p dpm-tests --test laws the_manual"
    );
}

/// The groups that the renderer is judged by are rig files without errors.
#[test]
fn every_group_is_a_rig() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs/groups");
    let files = std::fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().path());
    let rigs: Vec<_> = files.filter(|path| path.extension().is_some_and(|e| e == "toml")).collect();
    assert_eq!(rigs.len(), 16);
    for path in rigs {
        let text = std::fs::read_to_string(&path).unwrap();
        let overrides = Overrides { variables: vec![], flags: vec![] };
        RigConfig::parse(&path.to_string_lossy(), &text, &root, &overrides).unwrap_or_else(|e| panic!("{e}"));
    }
}

/// Every template is a rig file without errors, and a page names it.
#[test]
fn every_template_is_a_rig() {
    dpm::satellites::register();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let page = std::fs::read_to_string(root.join("docs/PROJECTORS.md")).unwrap();
    let mut kinds = Vec::new();
    for entry in std::fs::read_dir(root.join("rigs")).unwrap() {
        let path = entry.unwrap().path();
        // Groups are no templates.
        if path.is_dir() {
            continue;
        }
        let name = format!("rigs/{}", path.file_name().unwrap().to_string_lossy());
        let text = std::fs::read_to_string(&path).unwrap();
        let overrides = Overrides { variables: vec![], flags: vec![] };
        let rig =
            RigConfig::parse(&name, &text, &root.join("rigs"), &overrides).unwrap_or_else(|e| panic!("{e}"));
        assert!(page.contains(&format!("](../{name})")), "docs/PROJECTORS.md does not name {name}");
        kinds.push(rig.projector.backend.word());
    }
    for kind in ["mock", "usb", "alp", "dlpc900", "display", "window"] {
        assert!(kinds.contains(&kind), "no template for {kind}: {kinds:?}");
    }
}
