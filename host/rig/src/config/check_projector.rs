//! Contradictions between the keys of `[projector]`.

use super::check::{contradict, refuse, shown};
use super::{
    AlpConfig, AlpWeights, DisplayConfig, DisplayEncoding, Dlpc900Panel, PlaneWeights, ProjectorBackend,
    ProjectorConfig, RigConfig,
};
use dpm_common::keys::read::Reader;
use dpm_display::mode::ModeWish;

pub(super) fn projector(rig: &RigConfig, reader: &mut Reader) {
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
    if let ProjectorBackend::Dlpc900(dlpc900) = &p.backend {
        check_panel(p, "projector.backend.panel", dlpc900.panel, reader);
    }
    if let ProjectorBackend::Display(display) = &p.backend {
        check_display(p, display, reader);
    }
    if let ProjectorBackend::Alp(alp) = &p.backend {
        check_alp(p, alp, reader);
    }
    let no_equal_planes = match &p.backend {
        ProjectorBackend::Window(_) => Some("a window shows code values, whose bits have binary weights"),
        ProjectorBackend::Dlpc900(_) => Some("a DLPC900 weights the bits of loaded frames itself"),
        _ => None,
    };
    if let (Some(why), PlaneWeights::Equal) = (no_equal_planes, p.weights) {
        let backend = ("projector.backend.kind", format!("{:?}", p.backend.word()));
        contradict(reader, &[weights_of(p), backend], why, "leave `projector.weights` out".into());
    }
    if matches!(p.backend, ProjectorBackend::Dlpc900(_)) && num > 120 * den {
        contradict(
            reader,
            &[
                ("projector.frame_rate", shown(p.frame_rate)),
                ("projector.backend.kind", format!("{:?}", p.backend.word())),
            ],
            "a DLPC900 shows at most 120 frames/s of 24 planes",
            "lower `projector.frame_rate` to 120 or choose another backend".into(),
        );
    }
}

/// The weights, as a contradiction names them.
fn weights_of(p: &ProjectorConfig) -> (&'static str, String) {
    ("projector.weights", format!("{:?}", p.weights.word()))
}

/// A display, and the controller behind it.
fn check_display(p: &ProjectorConfig, display: &DisplayConfig, reader: &mut Reader) {
    if let Err(e) = display.mode.parse::<ModeWish>() {
        refuse(reader, &["projector.backend.mode"], e.to_string(), "`dpm display` lists the modes".into());
    }
    let encoding = ("projector.backend.encoding", shown(display.encoding));
    let is_behind = display.dlpc900.is_some();
    if p.planes != 24 && (display.encoding != DisplayEncoding::Rgb8 || is_behind) {
        contradict(
            reader,
            &[
                ("projector.planes", shown(p.planes)),
                encoding.clone(),
                ("projector.backend.kind", format!("{:?}", p.backend.word())),
            ],
            "a pixel carries 24 planes",
            "set projector.planes = 24".into(),
        );
    }
    if display.encoding.needs_dlpc900() && !is_behind {
        contradict(
            reader,
            &[encoding.clone(), ("projector.backend.dlpc900", "not there".into())],
            "only a DLPC900 cuts pixels into such patterns",
            "add the table [projector.backend.dlpc900], or use encoding = \"rgb8\"".into(),
        );
    }
    if display.encoding == DisplayEncoding::Rgb8 && p.weights == PlaneWeights::Equal && !is_behind {
        contradict(
            reader,
            &[weights_of(p), encoding, ("projector.backend.kind", format!("{:?}", p.backend.word()))],
            "the bits of a code value have binary weights",
            "leave `projector.weights` out, or use encoding = \"planes24\"".into(),
        );
    }
    if let Some(behind) = &display.dlpc900 {
        check_panel(p, "projector.backend.dlpc900.panel", behind.panel, reader);
        check_behind(p, display, reader);
    }
}

/// A controller behind a display: its patterns must fit a frame, and weights be those of its patterns if they are told at all.
fn check_behind(p: &ProjectorConfig, display: &DisplayConfig, reader: &mut Reader) {
    if reader.is_written("projector.weights") && p.weights != display.encoding.weights() {
        let why = match display.encoding.weights() {
            PlaneWeights::Equal => "a DLPC900 lights all planes of a pixel equally long",
            PlaneWeights::Binary => "a DLPC900 weights the bits of a pattern itself",
        };
        contradict(
            reader,
            &[weights_of(p), ("projector.backend.encoding", shown(display.encoding))],
            why,
            "leave `projector.weights` out: the encoding decides it".into(),
        );
    }
    if let Some(Err(why)) = display.exposure_us(p.frame_rate) {
        refuse(
            reader,
            &["projector.backend.dlpc900.exposure_us", "projector.frame_rate"],
            why.to_string(),
            "leave `projector.backend.dlpc900.exposure_us` out, or lower `projector.frame_rate`".into(),
        );
    }
    if p.frame_rate.num() > 120 * p.frame_rate.den() {
        contradict(
            reader,
            &[("projector.frame_rate", shown(p.frame_rate))],
            "a DLPC900 receives at most 120 video frames/s",
            "choose a mode with a lower rate".into(),
        );
    }
}

/// A controller's panel has as many mirrors as the projector.
fn check_panel(p: &ProjectorConfig, key: &str, panel: Dlpc900Panel, reader: &mut Reader) {
    let raster = panel.dmd().raster();
    if (p.width, p.height) != (raster.width(), raster.height()) {
        contradict(
            reader,
            &[
                ("projector.width", shown(p.width)),
                ("projector.height", shown(p.height)),
                (key, shown(panel)),
                ("projector.backend.kind", format!("{:?}", p.backend.word())),
            ],
            &format!("a {} has {} x {} mirrors", panel.dmd().name(), raster.width(), raster.height()),
            format!("set projector.width = {} and projector.height = {}", raster.width(), raster.height()),
        );
    }
}

/// An ALP has one picture time for each sequence, so binary weights take a sequence for each plane. What the panel, its memory and its cable
/// hold is known when it is opened.
fn check_alp(p: &ProjectorConfig, alp: &AlpConfig, reader: &mut Reader) {
    if alp.weights != AlpWeights::Binary {
        return;
    }
    let weights = ("projector.backend.weights", shown(alp.weights));
    if p.weights == PlaneWeights::Equal {
        contradict(
            reader,
            &[weights, ("projector.weights", shown(p.weights))],
            "halftones need planes of equal light",
            "set projector.backend.weights = \"equal\", or leave projector.weights out".into(),
        );
        return;
    }
    if p.planes != 8 {
        contradict(
            reader,
            &[weights, ("projector.planes", shown(p.planes))],
            "binary weights are for the eight planes of one channel",
            "set projector.planes = 8, or projector.backend.weights = \"equal\"".into(),
        );
    } else if alp.slots_per_sequence > 1 {
        contradict(
            reader,
            &[("projector.backend.slots_per_sequence", shown(alp.slots_per_sequence)), weights],
            "a frame of binary weights is several sequences, which the device does not repeat as one",
            "set projector.backend.slots_per_sequence = 1, or projector.backend.weights = \"equal\"".into(),
        );
    }
}

/// The keys that say how to read the calibration file.
fn calibration(p: &ProjectorConfig, reader: &mut Reader) {
    if p.calibration.is_none() {
        for key in ["calibration_lens", "calibration_region", "calibration_camera"] {
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
            "set projector.calibration_unit to \"metre\" or \"millimetre\"".into(),
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
