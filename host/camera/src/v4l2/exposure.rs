//! Exposure and gain of a camera, by hand: an exposure that the camera changes by itself has no middle that is known.

use super::abi::{
    ControlRange, ANALOGUE_GAIN, AUTO_GAIN, BY_HAND, CONTROL_DISABLED, EXPOSURE_ABSOLUTE, EXPOSURE_AUTO,
    EXPOSURE_OVER_RATE, GAIN, IRIS_BY_CAMERA, QUERY_CONTROL,
};
use super::kernel::Node;
use crate::source::{CameraDoubt, PictureRequest};

/// The unit of the control for the exposure, microseconds.
const UNIT_US: i64 = 100;

/// The range of a control; `None` if the camera has none.
fn range(node: &Node, id: u32) -> Option<ControlRange> {
    let mut range = ControlRange { id, ..ControlRange::default() };
    node.call(&QUERY_CONTROL, &mut range).ok()?;
    (range.flags & CONTROL_DISABLED == 0).then_some(range)
}

/// Whether the camera leaves its exposure alone. A camera without the control has no automatic.
fn is_by_hand(node: &Node) -> bool {
    node.control(EXPOSURE_AUTO).map_or(true, |mode| mode == BY_HAND || mode == IRIS_BY_CAMERA)
}

/// Sets exposure and gain as `request` asks. The exposure that counts, ns.
///
/// # Errors
/// The camera cannot do what is asked, or its exposure is not known.
pub(super) fn set(
    node: &Node,
    place: &str,
    request: &PictureRequest,
    doubts: &mut Vec<CameraDoubt>,
) -> Result<i64, CameraDoubt> {
    if let Some(gain) = request.gain {
        set_gain(node, place, gain)?;
    }
    let exposure_ns = match (request.exposure_us, range(node, EXPOSURE_ABSOLUTE)) {
        (Some(us), Some(range)) => set_exposure(node, place, us, &range, doubts)?,
        (Some(us), None) => {
            let found = format!("{place} has no control for its exposure; {us} us is believed");
            let remedy = "see that the camera's own setting is tracker.exposure_us, and by hand";
            doubts.push(CameraDoubt::new(found, remedy));
            i64::from(us) * 1_000
        }
        (None, Some(_)) if is_by_hand(node) => {
            let value = node.control(EXPOSURE_ABSOLUTE).map_err(|e| unknown(place, &e.to_string()))?;
            i64::from(value.max(1)) * UNIT_US * 1_000
        }
        (None, Some(_)) => return Err(unknown(place, "the camera changes it by itself")),
        (None, None) => return Err(unknown(place, "the camera has no control for it")),
    };
    judge(place, exposure_ns, request, doubts);
    Ok(exposure_ns)
}

fn unknown(place: &str, why: &str) -> CameraDoubt {
    CameraDoubt::new(
        format!("{place}: its exposure is not known ({why}), so the time of its pictures is not"),
        "set tracker.exposure_us, for example to 2000",
    )
}

fn set_exposure(
    node: &Node,
    place: &str,
    us: u32,
    range: &ControlRange,
    doubts: &mut Vec<CameraDoubt>,
) -> Result<i64, CameraDoubt> {
    if let Some(modes) = range_of_modes(node) {
        let by_hand = [BY_HAND, IRIS_BY_CAMERA].into_iter().filter(|m| modes.contains(m));
        let set = by_hand.map(|mode| node.set_control(EXPOSURE_AUTO, mode)).find(Result::is_ok);
        if set.is_none() && !is_by_hand(node) {
            let found = format!("{place} does not let its exposure be set by hand");
            return Err(CameraDoubt::new(
                found,
                "use a camera that does: its pictures have no time otherwise",
            ));
        }
    }
    // Cameras that have this would take fewer pictures in the dark. Others answer EINVAL.
    let _ = node.set_control(EXPOSURE_OVER_RATE, 0);
    let wanted = (i64::from(us) + UNIT_US / 2) / UNIT_US;
    let within = i64::from(range.least)..=i64::from(range.most);
    if !within.contains(&wanted) {
        let [least, most] = [range.least, range.most].map(|value| i64::from(value) * UNIT_US);
        let found = format!("{place} has exposures of {least} to {most} us, and not {us}");
        return Err(CameraDoubt::new(found, "set tracker.exposure_us within them"));
    }
    let given = node.set_control(EXPOSURE_ABSOLUTE, wanted as i32).map_err(|e| {
        let found = format!("{place} refuses an exposure of {us} us: {e}");
        CameraDoubt::new(found, "set tracker.exposure_us to another value, or plug the camera in again")
    })?;
    // The answer may be what was asked, with another value behind it.
    let given = i64::from(node.control(EXPOSURE_ABSOLUTE).unwrap_or(given).max(1)) * UNIT_US;
    if (given - i64::from(us)).abs() > i64::from(us) / 10 {
        let found = format!("{place} exposes for {given} us where {us} us are asked");
        doubts.push(CameraDoubt::new(found, format!("set tracker.exposure_us = {given}, or another value")));
    }
    Ok(given * 1_000)
}

/// The numbers that the control for automatic exposure may have.
fn range_of_modes(node: &Node) -> Option<std::ops::RangeInclusive<i32>> {
    range(node, EXPOSURE_AUTO).map(|range| range.least..=range.most)
}

fn set_gain(node: &Node, place: &str, gain: u32) -> Result<(), CameraDoubt> {
    let found = [GAIN, ANALOGUE_GAIN].into_iter().find_map(|id| Some((id, range(node, id)?)));
    let Some((id, range)) = found else {
        let found = format!("{place} has no control for its gain");
        return Err(CameraDoubt::new(found, "leave out tracker.gain"));
    };
    if !(i64::from(range.least)..=i64::from(range.most)).contains(&i64::from(gain)) {
        let found = format!("{place} has a gain of {} to {}, and not {gain}", range.least, range.most);
        return Err(CameraDoubt::new(found, "set tracker.gain within them"));
    }
    // A camera without the automatic answers EINVAL.
    let _ = node.set_control(AUTO_GAIN, 0);
    node.set_control(id, gain as i32).map(drop).map_err(|e| {
        CameraDoubt::new(format!("{place} refuses a gain of {gain}: {e}"), "leave out tracker.gain")
    })
}

/// An exposure that is long beside the time of a picture blurs, and its middle is old.
fn judge(place: &str, exposure_ns: i64, request: &PictureRequest, doubts: &mut Vec<CameraDoubt>) {
    let half_ns = 500_000_000 / i64::from(request.rate_hz.max(1));
    if exposure_ns > half_ns {
        let found = format!(
            "{place} exposes for {:.1} ms, longer than half the time of a picture ({:.1} ms)",
            1e-6 * exposure_ns as f64,
            1e-6 * half_ns as f64
        );
        let remedy =
            "set tracker.exposure_us shorter, with more light or tracker.gain: what moves is blurred over it";
        doubts.push(CameraDoubt::new(found, remedy));
    }
}
