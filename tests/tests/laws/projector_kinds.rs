//! What holds for every kind of projectors: one suite over all rows of the table, and over a kind that a stranger adds.

use dpm_common::keys::read::Any;
use dpm_common::section;
use dpm_device::link::Codec;
use dpm_device::time::FrameRate;
use dpm_rig::calibration_steps::is_simulated;
use dpm_rig::config::{Overrides, Purpose, RigConfig};
use dpm_rig::pipeline::projector::{link_settings, look, panel};
use dpm_rig::projectors::{
    add, backend, kinds, Cable, DeviceName, FrameRoad, LitTime, ProjectorKeys, ProjectorKind, SlotClock,
};
use dpm_rig::standing::Identity;
use std::path::Path;

/// A rig with this projector, of a size and a rate that all kinds can have.
fn rig(kind: &ProjectorKind, more: &[&str]) -> Result<RigConfig, String> {
    rig_for(kind, more, Purpose::default())
}

fn rig_for(kind: &ProjectorKind, more: &[&str], purpose: Purpose) -> Result<RigConfig, String> {
    let size = ["projector.width=1920", "projector.height=1080", "projector.frame_rate=60"];
    let own = [format!("projector.backend.kind={:?}", kind.word.word), "real_time.pace=\"real\"".into()];
    let flags = size.iter().chain(more).map(|key| (*key).to_owned()).chain(own).collect();
    let overrides = Overrides { variables: vec![], flags };
    RigConfig::parse_for("rig.toml", "", Path::new(""), &overrides, purpose).map_err(|e| e.to_string())
}

/// What the program tells of it: a word of its own, keys with a text each, and a page.
fn is_documented(kind: &ProjectorKind) {
    let word = kind.word.word;
    assert_eq!(kinds().iter().filter(|other| other.word.word == word).count(), 1, "{word} stands twice");
    assert!(!kind.word.about.is_empty() && !kind.name.is_empty());
    let docs = RigConfig::key_docs();
    for key in kind.word.keys {
        let within = format!("projector.backend({word}).{key}");
        let own: Vec<_> = docs.iter().filter(|doc| doc.key.starts_with(&within)).collect();
        assert!(!own.is_empty() && own.iter().all(|doc| doc.doc.len() > 10), "{within} is not in the manual");
    }
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(kind.page);
    assert!(page.is_file(), "{} is not there", kind.page);
    let told = rig(kind, &["projector.backend.no_such_key=1"]).expect_err("refused");
    assert!(told.contains("no_such_key"), "{told}");
}

/// It is known by the same name whenever it is asked, and by another one than the other kinds.
fn has_a_name(kind: &ProjectorKind) {
    let of = |kind: &ProjectorKind| Identity::of(&backend(kind.word.word).expect("a kind"));
    let (one, again) = (of(kind), of(kind));
    assert!(!one.what().is_empty() && one.lock_name() == again.lock_name());
    assert_eq!(one.is_mock(), kind.road == FrameRoad::Mock);
    for other in kinds().into_iter().filter(|other| other.word.word != kind.word.word) {
        assert_ne!(one.lock_name(), of(other).lock_name(), "{} and {}", kind.name, other.name);
    }
}

/// Its light lies within a frame, and its delay within a second, at any rate.
fn has_light_in_its_time(kind: &ProjectorKind) {
    for rate in ["60", "120"] {
        let p =
            rig(kind, &[&format!("projector.frame_rate={rate}")]).unwrap_or_else(|e| panic!("{e}")).projector;
        let LitTime { whole_ns, dark_ns, frame_ns } = p.lit_time();
        assert!(0 < whole_ns && whole_ns <= frame_ns, "{whole_ns} of {frame_ns} ns");
        assert!((0..whole_ns).contains(&dark_ns), "{dark_ns} of {whole_ns} ns");
        assert!((0..1_000_000_000).contains(&p.light_delay_ns()), "{} ns", p.light_delay_ns());
        assert!([8, 24].contains(&p.schedule().len()));
        assert!((1..=255).contains(&p.full_light()), "{}", p.full_light());
    }
}

/// The link is told what the kind says of itself, and planes as they are always pass.
fn has_a_link(kind: &ProjectorKind) {
    let config = rig(kind, &[]).unwrap_or_else(|e| panic!("{e}"));
    let raster = config.projector.raster();
    let settings = link_settings(&config, raster);
    assert!(settings.codecs & Codec::Raw.mask() != 0);
    assert_eq!(
        (settings.schedule, settings.rate),
        (config.projector.schedule(), FrameRate::new(60, 1).unwrap())
    );
    let panel = panel(&config, raster);
    assert!(panel.frame_bytes() > raster.plane_bytes() * panel.schedule.len());
    let backend = &config.projector.backend;
    match backend.cable() {
        Cable::Serial { bytes_per_s } => assert!(bytes_per_s > 0 && !backend.carries_tracks()),
        Cable::Usb | Cable::InProcess => {}
    }
    assert_eq!(backend.as_mock().is_some(), backend.is_mock());
    assert!(kind.slots == SlotClock::Firmware || kind.is_video, "blanks are those of a video signal");
    // A look opens nothing; what is missing is named.
    if let Err(missing) = look(&config) {
        assert!(missing.to_string().len() > 10, "{missing}");
    }
}

/// What every run relies on: only the mock runs on a clock of this program, and takes the place of any other; what shows
/// loaded frames keeps no limit and spares no head, and says so.
fn keeps_the_rules_of_runs(kind: &ProjectorKind) {
    let refused = |keys: &[&str]| rig(kind, keys).err();
    let is_mock = kind.road == FrameRoad::Mock;
    let simulated = rig_for(kind, &[], Purpose { simulate: true, ..Purpose::default() });
    assert!(is_simulated(&simulated.unwrap_or_else(|e| panic!("{e}"))));
    let virtual_pace = RigConfig::parse(
        "rig.toml",
        "",
        Path::new(""),
        &Overrides {
            variables: vec![],
            flags: vec![
                format!(
                    "projector={{width=1920,height=1080,frame_rate=60,backend={{kind={:?}}}}}",
                    kind.word.word
                ),
                "real_time.pace=\"virtual\"".into(),
                "run.frames=1".into(),
            ],
        },
    );
    assert_eq!(virtual_pace.is_ok(), is_mock, "{virtual_pace:?}");
    let limit = refused(&["safety.limits.full_white_s=2.0"]);
    let head = refused(&["observer.tracked=\"glasses\""]);
    let short = refused(&["safety.watchdog_ms=20"]);
    let is_loaded = kind.road == FrameRoad::Loaded;
    assert_eq!(
        [limit.is_some(), head.is_some(), short.is_none()],
        [is_loaded; 3],
        "{limit:?}, {head:?}, {short:?}"
    );
    for told in limit.iter().chain(&head) {
        assert!(told.contains(kind.name), "{told}");
    }
    assert!(
        !is_loaded || backend(kind.word.word).expect("a kind").guardian().is_some(),
        "nobody ends its light"
    );
}

fn judge(kind: &ProjectorKind) {
    is_documented(kind);
    has_a_name(kind);
    has_light_in_its_time(kind);
    has_a_link(kind);
    keeps_the_rules_of_runs(kind);
}

#[test]
fn every_kind_of_projectors_keeps_the_laws_of_all() {
    dpm::satellites::register();
    assert!(kinds().len() >= 7);
    kinds().into_iter().for_each(judge);
}

section! {
    /// A lantern.
    pub struct LanternConfig {
        /// The number that is painted on it.
        number: u32 = 7, "", Any;
    }
}

static LANTERN: ProjectorKind =
    ProjectorKind::of::<LanternConfig>("lantern", "lantern", "a lantern for tests.", "docs/PROJECTORS.md");

impl ProjectorKeys for LanternConfig {
    fn device(&self) -> DeviceName {
        DeviceName { named: Some(self.number.to_string()), is_proof: true, ..DeviceName::of(LANTERN.name) }
    }
}

/// A stranger's kind: its keys, what names it, and this row.
#[test]
fn a_kind_is_an_object_and_a_row() {
    dpm::satellites::register();
    add(&LANTERN);
    judge(&LANTERN);
    assert!(RigConfig::manual().contains("## `[projector.backend]` with `kind = \"lantern\"`"));
    let config = rig(&LANTERN, &["projector.backend.number=9"]).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(Identity::of(&config.projector.backend).what(), "lantern 9");
    assert_eq!(config.projector.backend.keys(), Some(&LanternConfig { number: 9 }));
}
