use super::*;
use crate::config::{Overrides, RigConfig};
use applied::{middles, ParameterVersion};
use dpm_device::planes::Raster;
use proptest::prelude::*;
use std::sync::Arc;

fn rig(flags: &[&str]) -> Arc<Rig> {
    let flags = flags.iter().map(|f| (*f).to_owned()).collect();
    let config = RigConfig::demo(&Overrides { flags, variables: vec![] }).unwrap();
    Arc::new(Rig::build(&config, Raster::new(8, 8)).unwrap())
}

#[test]
fn without_a_change_planning_has_the_rigs_own_bits() {
    let rig = rig(&["render.exposure=0.37"]);
    let first = ParameterVersion::new(0, &Values::of(&rig), &rig, &middles(&rig));
    assert_eq!(first.brighter.to_bits(), 1.0f32.to_bits());
    assert_eq!((first.camera, first.gaze), (rig.camera, None));
    for (body, place) in rig.bodies.iter().zip(&first.mesh_to_body) {
        assert_eq!(
            body.mesh_to_body.to_cols_array().map(f64::to_bits),
            place.to_cols_array().map(f64::to_bits)
        );
    }
    assert_eq!(
        (first.samples, first.most_milli),
        (rig.config.render.spp, 1000 * u64::from(rig.config.render.spp))
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// Whatever is set, planning gets finite numbers within the ranges, and refusals change nothing.
    #[test]
    fn any_numbers_leave_planning_with_sound_ones(
        name in prop::sample::select(vec!["exposure", "samples", "budget", "gaze", "projector", "body.venus"]),
        numbers in prop::collection::vec(any::<f64>(), 0..8),
        scale in prop::sample::select(vec![1.0, 1e-300, 1e-307]),
    ) {
        static RIG: std::sync::OnceLock<Arc<Rig>> = std::sync::OnceLock::new();
        let rig = RIG.get_or_init(|| rig(&[]));
        let numbers: Vec<f64> = numbers.iter().map(|n| n * scale).collect();
        let parameter = Parameter::named(name, rig).unwrap();
        let mut values = Values::of(rig);
        let before = values.clone();
        if values.set(parameter, &numbers, rig).is_err() {
            prop_assert_eq!(&values, &before);
        }
        let applied = ParameterVersion::new(1, &values, rig, &middles(rig));
        prop_assert!(applied.brighter.is_finite() && applied.brighter > 0.0);
        prop_assert!((1..=4096).contains(&applied.samples) && (1..=4_096_000).contains(&applied.most_milli));
        prop_assert!(applied.camera.world_from_projector.is_finite());
        prop_assert!(applied.mesh_to_body.iter().all(|m| m.is_finite()));
        prop_assert!(applied.gaze.is_none_or(|g| g.is_finite()));
    }
}
