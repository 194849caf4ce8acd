use super::*;
use dpm_device::planes::Raster;
use glam::DAffine3;

const RIG: &str = "# My rig.\n[render] # how\nspp = 2 # few\n# exposure = 7\n\n[observer]\ngaze = { kind = \"straight\" } # ahead\n";

fn gaze() -> Setting {
    Setting::Table(vec![("kind", Setting::Text("point".into())), ("point", Setting::Point([0.0, 0.5, -1.0]))])
}

#[test]
fn only_the_values_change_and_comments_stay() {
    let keys = [
        (["render", "spp"], Setting::Whole(5)),
        (["render", "exposure"], Setting::Number(2.0)),
        (["observer", "gaze"], gaze()),
    ];
    let new = edited(RIG, &keys).unwrap();
    assert_eq!(
        new,
        "# My rig.\n[render] # how\nexposure = 2.0\nspp = 5 # few\n# exposure = 7\n\n[observer]\ngaze = { kind = \"point\", point = [0.0, 0.5, -1.0] } # ahead\n"
    );
    // A section that is missing comes at the end, also after a line without its line feed.
    let new = edited("[render]\nspp = 2", &[(["observer", "gaze"], gaze())]).unwrap();
    assert!(new.starts_with("[render]\nspp = 2\n\n[observer]\ngaze = {"), "{new}");
    assert_eq!(edited("", &keys[..1]).unwrap(), "\n[render]\nspp = 5\n");
}

#[test]
fn a_form_that_is_not_edited_is_refused_with_what_to_write() {
    for text in ["render = { spp = 2 }\n", "render.spp = 2\n", "[observer.gaze]\nkind = \"straight\"\n"] {
        let keys = [(["render", "exposure"], Setting::Number(2.0)), (["observer", "gaze"], gaze())];
        match edited(text, &keys) {
            Ok(new) => panic!("{new}"),
            Err(told) => assert!(told.contains("by hand"), "{told}"),
        }
    }
    assert!(edited("[render\n", &[]).is_err());
}

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("dpm-keep-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        std::fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }

    fn rig(&self, text: &str) -> (PathBuf, Rig) {
        let path = self.0.join("rig.toml");
        std::fs::write(&path, text).unwrap();
        let purpose = Purpose { at_rest: true, ..Purpose::default() };
        let config = RigConfig::load_for(&path, &Overrides::default(), purpose).unwrap();
        (path, Rig::build(&config, Raster::new(8, 8)).unwrap())
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[test]
fn the_next_run_has_the_values_and_the_old_file_is_kept() {
    let folder = Folder::new("file");
    let (path, rig) = folder.rig(RIG);
    let kept = ToKeep { keys: vec![(["render", "exposure"], Setting::Number(2.5))], ..ToKeep::default() };
    let told = saver(path.clone())(&rig, &kept).unwrap();
    assert!(told.contains("rig.toml.1.old"), "{told}");
    let config = RigConfig::load(&path, &Overrides::default()).unwrap_or_else(|_| {
        let purpose = Purpose { at_rest: true, ..Purpose::default() };
        RigConfig::load_for(&path, &Overrides::default(), purpose).unwrap()
    });
    assert_eq!(config.render.exposure, 2.5);
    assert_eq!(std::fs::read_to_string(folder.0.join("rig.toml.1.old")).unwrap(), RIG);
    // A value that the rig file may not have leaves everything as it was.
    let before = std::fs::read_to_string(&path).unwrap();
    let kept = ToKeep { keys: vec![(["render", "exposure"], Setting::Number(-1.0))], ..ToKeep::default() };
    let told = saver(path.clone())(&rig, &kept).unwrap_err();
    assert!(told.contains("not be valid"), "{told}");
    assert_eq!(std::fs::read_to_string(&path).unwrap(), before);
}

#[test]
fn a_motion_that_cannot_be_kept_is_refused_before_a_file_is_touched() {
    let folder = Folder::new("motion");
    let (path, rig) = folder.rig(RIG);
    let keys = vec![(["render", "exposure"], Setting::Number(2.5))];
    let body = vec![("bunny".to_owned(), DAffine3::IDENTITY)];
    let told = saver(path.clone())(&rig, &ToKeep { bodies: body, keys: keys.clone(), projector: None });
    assert!(told.unwrap_err().contains("mock tracker"));
    let projector = Some(DAffine3::IDENTITY);
    let told = saver(path.clone())(&rig, &ToKeep { bodies: vec![], keys, projector });
    assert!(told.unwrap_err().contains("dpm calibrate projector"));
    assert_eq!(std::fs::read_to_string(&path).unwrap(), RIG);
    assert!(no_file()(&rig, &ToKeep::default()).unwrap_err().contains("rigs/demo.toml"));
}
