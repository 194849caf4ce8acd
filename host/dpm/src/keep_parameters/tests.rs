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

struct KeptFolder(PathBuf);

impl KeptFolder {
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

impl Drop for KeptFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[test]
fn the_next_run_has_the_values_and_the_old_file_is_kept() {
    let folder = KeptFolder::new("file");
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
    let folder = KeptFolder::new("motion");
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

/// Found in use, O7: the motion was kept in a calibration file that the next run did not read, because the rig file did
/// not name it.
#[test]
fn a_motion_that_is_kept_moves_the_light_of_the_next_run() {
    let folder = KeptFolder::new("named");
    let text = "# Mine.\n[tracker] # far\nkind = \"natnet\"\nserver = \"127.0.0.1\"\n[[scene.bodies]]\nname = \"bunny\"\n";
    let (path, rig) = folder.rig(text);
    assert_eq!(rig.config.calibration.file, None);
    let moved = DAffine3::from_translation(glam::DVec3::new(0.01, -0.02, 0.03));
    let kept = ToKeep { bodies: vec![("bunny".to_owned(), moved)], ..ToKeep::default() };
    let told = saver(path.clone())(&rig, &kept).unwrap();
    assert!(told.contains("calibration.toml") && !told.contains("name it in the rig file"), "{told}");
    let written = std::fs::read_to_string(&path).unwrap();
    assert_eq!(written, format!("{text}\n[calibration]\nfile = \"calibration.toml\"\n"));
    assert_eq!(std::fs::read_to_string(folder.0.join("rig.toml.1.old")).unwrap(), text);
    let purpose = || Purpose { at_rest: true, ..Purpose::default() };
    let next = RigConfig::load_for(&path, &Overrides::default(), purpose()).unwrap();
    let body = |rig: &Rig| rig.bodies.iter().find(|b| b.name == "bunny").unwrap().mesh_to_body;
    let next = Rig::build(&next, Raster::new(8, 8)).unwrap();
    assert!(body(&next).abs_diff_eq(moved, 1e-12), "{:?}", body(&next));
    // From then on the entry is there, and the rig file stays as it is.
    let again = DAffine3::from_translation(glam::DVec3::new(0.0, 0.0, 0.5));
    let kept = ToKeep { bodies: vec![("bunny".to_owned(), again)], ..ToKeep::default() };
    saver(path.clone())(&next, &kept).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), written);
    // A rig file in which the entry cannot be made leaves both files as they were.
    let (path, rig) = folder.rig(&format!("{text}[projector]\nwidth = 640\nheight = 480\n"));
    std::fs::remove_file(folder.0.join("calibration.toml")).unwrap();
    std::fs::write(&path, "calibration = {}\n").unwrap();
    let told = saver(path.clone())(&rig, &kept).unwrap_err();
    assert!(told.contains("by hand"), "{told}");
    assert!(!folder.0.join("calibration.toml").exists());
}
