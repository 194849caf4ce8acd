use super::*;
use crate::config::{Overrides, RigConfig};
use dpm_device::planes::Raster;

fn rig(flags: &[&str]) -> Rig {
    let flags = flags.iter().map(|f| (*f).to_owned()).chain(["render.method=auto".into()]).collect();
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"))
}

fn choice(key: String) -> MethodChoice {
    let of = |method: &str, error: f64| MethodCandidate {
        method: method.into(),
        spp: 3.0,
        time_to_dpm: 1.01,
        error,
        runs: [0.5 * error, 2.0 * error],
    };
    MethodChoice {
        key,
        method: "own".into(),
        spp: 4,
        budget_spp: Some(3.25),
        zone_spp: [7, 7, 1],
        device: "a card".into(),
        commit: "0".into(),
        candidates: vec![of("own", 0.02), of("dpm", 0.03)],
    }
}

/// A folder of this test, which is removed at its end.
struct ChoiceFolder(PathBuf);

impl ChoiceFolder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for ChoiceFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[test]
fn another_scene_rig_or_device_has_another_key() {
    let card = "a card";
    let own = key(&rig(&[]), card);
    assert_eq!(own, key(&rig(&[]), card));
    assert_eq!(own, key(&rig(&["render.seed=9"]), card), "whatever the seed is, the method is one");
    let mut keys = vec![own, key(&rig(&[]), "another card")];
    for flag in
        ["render.spp=3", "render.depth=2", "observer.position=[0.0,0.5,1.0]", "projector.frame_rate=\"240\""]
    {
        keys.push(key(&rig(&[flag]), card));
    }
    // The content of the scene, whatever file it came from.
    let changes: [fn(&mut Rig); 6] = [
        |rig| rig.scene.bodies[0].mesh.positions[0].x += 1e-6,
        |rig| rig.scene.bodies[0].mesh.uvs[1].y += 0.5,
        |rig| rig.scene.materials[0].roughness += 0.01,
        |rig| rig.scene.textures[0].texels[3][1] ^= 1,
        |rig| rig.scene.environment = Environment::Constant(glam::Vec3::splat(0.25)),
        |rig| rig.camera.raster = Raster::new(32, 16).unwrap(),
    ];
    for change in changes {
        let mut other = rig(&[]);
        change(&mut other);
        keys.push(key(&other, card));
    }
    for (i, a) in keys.iter().enumerate() {
        assert!(!keys[..i].contains(a), "key {i} is there before: {keys:?}");
    }
}

#[test]
fn a_run_has_the_method_and_the_samples_of_its_file() {
    let (folder, card) = (ChoiceFolder::new("method-choice"), "a card");
    let wanted = choice(key(&rig(&[]), card));
    wanted.write(&folder.0).unwrap();
    for _ in 0..2 {
        let mut rig = rig(&[]);
        decide_by(&mut rig, card, Some(&folder.0));
        let render = &rig.config.render;
        assert_eq!((render.method, render.spp, render.budget_spp), (RenderMethod::Own, 4, Some(3.25)));
        assert_eq!(render.paper.zone_spp, [7, 7, 1]);
        let told = rig.method_choice.unwrap();
        assert!(told.starts_with("own by measurement on a card") && told.contains("dpm 3.00 %"), "{told}");
    }
    // Another device, another scene: nothing was measured for them.
    for (mut rig, device) in [(rig(&[]), "b"), (rig(&["render.depth=2"]), "a card")] {
        decide_by(&mut rig, device, Some(&folder.0));
        let told = rig.method_choice.clone().unwrap();
        assert_eq!((rig.config.render.method, rig.config.render.spp), (RenderMethod::Dpm, 2));
        assert!(told.contains("nothing was measured") && told.contains("dpm plan"), "{told}");
    }
    // A rig that names its method is left alone.
    let mut named = rig(&[]);
    named.config.render.method = RenderMethod::Paper;
    decide_by(&mut named, card, Some(&folder.0));
    assert_eq!((named.config.render.method, named.method_choice), (RenderMethod::Paper, None));
}

#[test]
fn a_file_that_is_no_choice_of_this_key_is_named_and_not_used() {
    let (folder, card) = (ChoiceFolder::new("method-damaged"), "a card");
    let key = key(&rig(&[]), card);
    let good = choice(key.clone());
    let text = |change: fn(&mut MethodChoice)| {
        let mut bad = good.clone();
        change(&mut bad);
        serde_json::to_string(&bad).unwrap()
    };
    for bad in [
        "{".to_owned(),
        "{}".to_owned(),
        text(|c| c.method = "auto".into()),
        text(|c| c.method = "fast".into()),
        text(|c| c.spp = 0),
        text(|c| c.spp = 4097),
        text(|c| c.zone_spp = [1, 0, 1]),
        text(|c| c.budget_spp = Some(1e9)),
        text(|c| c.key = "0".into()),
    ] {
        std::fs::write(MethodChoice::path(&folder.0, &key), &bad).unwrap();
        let mut rig = rig(&[]);
        decide_by(&mut rig, card, Some(&folder.0));
        let told = rig.method_choice.unwrap();
        assert!(
            told.starts_with("dpm without") && told.contains(&format!("method-{key}.json")),
            "{bad}: {told}"
        );
        assert_eq!((rig.config.render.method, rig.config.render.spp), (RenderMethod::Dpm, 2));
    }
    std::fs::write(MethodChoice::path(&folder.0, &key), text(|_| ())).unwrap();
    assert_eq!(MethodChoice::read(&folder.0, &key).unwrap(), Some(good));
}

#[test]
fn own_is_dpm_without_history_and_filter_and_auto_is_dpm_until_it_is_decided() {
    let of = |method| RenderConfig { method, ..RenderConfig::default() }.to_method();
    let (dpm, own) = (of(RenderMethod::Dpm), of(RenderMethod::Own));
    let lean = dpm_render::method::Method {
        rate_map: false,
        temporal: false,
        spatial: false,
        history_cap: 0.0,
        ..dpm.clone()
    };
    assert_eq!(own, lean);
    assert_eq!(of(RenderMethod::Auto), dpm);
}
