//! `dpm calibrate wand`: the tip of a wand by turning it about a fixed point.

use super::dialogue::Dialogue;
use super::poses::Poses;
use dpm_calibration::file::WandSection;
use dpm_calibration::pivot::{trace, Pivot};
use dpm_common::clock::MonotonicClock;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::Results;
use glam::DVec3;
use std::time::{Duration, Instant};

/// Time between two lines of advice.
const ADVISE_EVERY: Duration = Duration::from_secs(2);

/// How well a ruler tells the tip, metres along an axis.
const RULER_M: f64 = 2e-3;

/// Keeps a tip that was measured with a ruler.
pub fn by_ruler(config: &RigConfig, name: &str, tip: DVec3, results: &mut Results) -> String {
    results.file.wand = Some(WandSection {
        tip: tip.to_array(),
        tip_sigma_m: RULER_M * 3f64.sqrt(),
        provenance: results.provenance(config, name, "typed in".into(), "ruler"),
    });
    format!(
        "tip taken as known to {:.0} mm; aiming by hand needs it better: turn the wand about its tip for that",
        1e3 * RULER_M
    )
}

/// Collects poses of the body `name` for `seconds` and writes the tip.
///
/// # Errors
/// The tracker fails (exit code 3), or the poses do not tell the tip (2, with what to do).
pub fn calibrate(
    config: &RigConfig,
    name: &str,
    seconds: f64,
    results: &mut Results,
    dialogue: &Dialogue,
) -> Result<String, Failure> {
    let poses = Poses::start(config, &[name.to_owned()], MonotonicClock::new(0))?;
    poses.wait_until_seen()?;
    dialogue.tell(&format!(
        "Put the tip of the wand \"{name}\" into a small dent. For {seconds:.0} s tilt it slowly to the left and right and\n\
         forward and back, by 30 degrees or more, while the tip stays in place."
    ));
    dialogue.ask("Press Enter to begin.")?;
    let mut pivot = Pivot::default();
    let mut seen = 0;
    poses.take();
    let (begin, mut told) = (Instant::now(), Instant::now());
    while begin.elapsed().as_secs_f64() < seconds {
        std::thread::sleep(Duration::from_millis(50));
        for pose in poses.take().into_iter().flatten() {
            pivot.add(pose);
            seen += 1;
        }
        if told.elapsed() >= ADVISE_EVERY {
            told = Instant::now();
            dialogue.tell(&format!("{:4.0} s: {}", begin.elapsed().as_secs_f64(), pivot.advice()));
        }
    }
    let tip = pivot.solve().map_err(|e| Failure::new(FailureKind::BadInput, e))?;
    let sigma = trace(&tip.covariance).sqrt();
    let data = format!("{seen} poses of \"{name}\" in {seconds:.0} s");
    results.file.wand = Some(WandSection {
        tip: tip.tip.to_array(),
        tip_sigma_m: sigma,
        provenance: results.provenance(config, name, data, "pivoting about a fixed point"),
    });
    let [x, y, z] = tip.tip.to_array().map(|v| 1e3 * v);
    Ok(format!(
        "tip at ({x:.2}, {y:.2}, {z:.2}) mm in the wand's body, known to {:.3} mm; residual {:.3} mm rms",
        1e3 * sigma,
        1e3 * tip.residual_m
    ))
}
