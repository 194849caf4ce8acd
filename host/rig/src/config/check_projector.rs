//! Contradictions between the keys of `[projector]`.

use super::check::{contradict, refuse, shown};
use super::{PlaneWeights, ProjectorConfig, ResponseConfig, RigConfig};
use dpm_common::keys::read::KeyReader;

pub(super) fn projector(rig: &RigConfig, reader: &mut KeyReader) {
    let p = &rig.projector;
    let (num, den) = (u64::from(p.frame_rate.num()), u64::from(p.frame_rate.den()));
    if num * u64::from(p.planes) > u64::from(p.max_planes_per_second) * den {
        let most = p.max_planes_per_second / p.planes.max(1);
        contradict(
            reader,
            &[
                ("projector.frame_rate", shown(p.frame_rate)),
                ("projector.planes", shown(p.planes)),
                ("projector.max_planes_per_second", shown(p.max_planes_per_second)),
            ],
            &format!(
                "{:.0} planes/s are more than the projector shows",
                p.frame_rate.hz() * f64::from(p.planes)
            ),
            format!("at most {most} frames/s of {} planes", p.planes),
        );
    }
    calibration(p, reader);
    if p.calibration.is_some() {
        for key in ["position", "look_at", "up", "horizontal_fov_deg"] {
            let key = format!("projector.{key}");
            if reader.is_written(&key) {
                refuse(
                    reader,
                    &[&key],
                    "is given twice: here and by `projector.calibration`".into(),
                    "remove one of the two".into(),
                );
            }
        }
    } else {
        let view = glam::DVec3::from(p.look_at) - glam::DVec3::from(p.position);
        let up = glam::DVec3::from(p.up);
        if view.length() < 1e-6 {
            contradict(
                reader,
                &[("projector.look_at", shown(p.look_at)), ("projector.position", shown(p.position))],
                "the projector looks at the point where it stands",
                "move `projector.look_at` into the scene".into(),
            );
        } else if up.length() < 1e-9 || view.normalize().cross(up.normalize()).length() < 1e-6 {
            contradict(
                reader,
                &[
                    ("projector.up", shown(p.up)),
                    ("projector.look_at", shown(p.look_at)),
                    ("projector.position", shown(p.position)),
                ],
                "up is zero or along the view, so the picture has no upper side",
                "use a direction across the view, for example [0, 0, -1] when looking down".into(),
            );
        }
    }
    measured_light(p, reader);
    p.backend.check(&p.frame_keys(), reader);
    if p.weights == PlaneWeights::Split && !p.dims_planes() {
        contradict(
            reader,
            &[
                ("projector.weights", shown(p.weights)),
                ("projector.backend.kind", format!("{:?}", p.backend.kind().word.word)),
            ],
            &format!("a {} does not dim its light from plane to plane", p.backend.kind().name),
            "leave `projector.weights` out, or give it the value that the page on this kind of projectors names".into(),
        );
    }
}

/// Response and flat field are of the planes with which they were measured.
fn measured_light(p: &ProjectorConfig, reader: &mut KeyReader) {
    let of_response = (p.response != ResponseConfig::default()).then_some("projector.response");
    let keys: Vec<&str> =
        of_response.into_iter().chain(p.flat_field.as_ref().map(|_| "projector.flat_field")).collect();
    let [first, ..] = keys[..] else {
        if p.measured_with.is_some() {
            let problem = "says how response and flat field were measured, but there are none".to_owned();
            refuse(reader, &["projector.measured_with"], problem, "remove it".into());
        }
        return;
    };
    let measured = p.weights_measured(p.measured_with);
    if measured != p.weights {
        contradict(
            reader,
            &[
                ("projector.weights", shown(p.weights)),
                ("projector.measured_with", shown(measured)),
                (first, "as measured".into()),
            ],
            "the light of other planes was measured, and what a code value gives is not known of these",
            format!(
                "set projector.weights = {}, or measure again with these planes and name them in projector.measured_with",
                shown(measured)
            ),
        );
    }
}

/// The keys that say how to read the calibration file.
fn calibration(p: &ProjectorConfig, reader: &mut KeyReader) {
    if p.calibration.is_none() {
        for key in ["calibration_lens", "calibration_region", "calibration_device", "calibration_camera"] {
            let key = format!("projector.{key}");
            if reader.is_written(&key) {
                let problem = "says how to read a calibration file, but there is none".to_owned();
                refuse(reader, &[&key], problem, "set projector.calibration or remove this key".into());
            }
        }
        return;
    }
    if p.calibration_unit.is_none() {
        refuse(
            reader,
            &["projector.calibration"],
            "the file does not state the unit of its lengths".into(),
            "set projector.calibration_unit to \"metre\", \"centimetre\" or \"millimetre\"".into(),
        );
    }
    let Some(camera) = &p.calibration_camera else { return };
    let key = "projector.calibration_camera.rotation";
    if camera.to_affine().is_none() {
        let problem = "is a quaternion of length zero".to_owned();
        refuse(reader, &[key], problem, "no rotation is [0, 0, 0, 1]".into());
    } else if camera.rotation.is_some() && reader.is_written("projector.calibration_camera.rotation_deg") {
        let problem = "is given twice: here and by `rotation`".to_owned();
        let key = "projector.calibration_camera.rotation_deg";
        refuse(reader, &[key], problem, "remove one of the two".into());
    }
}

#[cfg(test)]
mod tests;
