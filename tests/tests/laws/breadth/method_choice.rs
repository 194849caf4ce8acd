//! Method "auto" measured: the choice is what its own figures say, its key is that of a run, and the run draws by it.

use dpm_device::planes::Raster;
use dpm_lab::method_choice::choose;
use dpm_rig::config::{Overrides, RenderMethod, RigConfig};
use dpm_rig::method_choice::{device_of, key};
use dpm_rig::rig::Rig;
use dpm_tests::gpu::with_gpu;

#[test]
fn a_measured_choice_is_what_its_figures_say() {
    let flags = vec!["render.method=auto".to_owned(), "render.software_raster=[40,30]".into()];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    let build = || Rig::build(&config, Raster::new(40, 30));
    let cache = std::env::temp_dir().join(format!("dpm-choice-{}", std::process::id()));
    with_gpu(|gpu| {
        let mut parts = Vec::new();
        let choice = choose(&build, gpu, &cache, &mut |part| parts.push(part.to_owned()))
            .unwrap_or_else(|e| panic!("{e}"));
        let mut rig = build().unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(choice.key, key(&rig, &device_of(gpu)));
        for part in ["times", "reference", "dpm", "own", "sequence", "paper"] {
            assert!(parts.iter().any(|p| p == part), "{part}: {parts:?}");
        }
        let errors: Vec<f64> = choice.candidates.iter().map(|c| c.error).collect();
        assert!(errors.len() == 4 && errors.is_sorted(), "{choice:?}");
        assert!(errors.iter().all(|e| (1e-4..1.0).contains(e)), "{choice:?}");
        let of = |method: &str| choice.candidates.iter().find(|c| c.method == method).unwrap();
        let best = &choice.candidates[0];
        let wanted = if best.error < 0.97 * of("dpm").error { best } else { of("dpm") };
        assert_eq!(choice.method, wanted.method, "{choice:?}");
        assert_eq!((of("dpm").spp, of("dpm").time_to_dpm), (2.0, 1.0));
        // Whoever keeps nothing takes more samples in the same time.
        assert!(of("sequence").spp >= 2.0, "{choice:?}");
        choice.apply(&mut rig);
        let render = &rig.config.render;
        assert_ne!(render.method, RenderMethod::Auto);
        assert_eq!((render.method.word(), render.spp), (choice.method.as_str(), choice.spp));
    });
    std::fs::remove_dir_all(&cache).expect("the references were kept there");
}
