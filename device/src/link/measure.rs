//! Measures a running link with given content: frames a second, bytes a frame, and which side limits them.

use super::host::{HostLink, LinkCounters, LinkError, LinkState, SendOutcome};
use super::{DropReason, Status};
use crate::time::{DeviceTicks, HostTime};
use crate::transport::Transport;

/// The result of [`measure`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkMeasurement {
    /// Length of the measurement, nanoseconds.
    pub duration_ns: i64,
    /// Frames that the link accepted.
    pub frames_sent: u64,
    /// Frames that arrived whole.
    pub frames_whole: u64,
    /// Frames a second that arrived whole.
    pub frames_per_s: f64,
    /// Bytes a frame on the wire, mean.
    pub bytes_per_frame: f64,
    /// Planes sent raw, coded, and not at all.
    pub planes: [u64; 3],
    /// Offers refused because the medium had no room.
    pub link_busy: u64,
    /// Offers refused because the device had no buffer free: with no `link_busy` the link is faster than the frame rate.
    pub no_credit: u64,
}

impl LinkMeasurement {
    /// True when the medium, not the frame rate, set the pace.
    pub fn link_limits(&self) -> bool {
        self.link_busy > self.no_credit
    }
}

fn whole(s: &Status) -> u32 {
    s.frames_seen.wrapping_sub(s.frames_incomplete)
}

/// Offers frames as fast as the link takes them for `duration_ns`, and counts those that arrive. `content` fills the
/// planes of frame `n`; `clock` is the host's clock. `rest` is called when nothing can be done at once, and should wait
/// some ten microseconds. `stop` ends the measurement early, with the results so far. The link must be
/// [`LinkState::Streaming`], and stays so unless the device ends it.
///
/// # Errors
/// The link's, from polling.
///
/// # Panics
/// When the link is not streaming.
pub fn measure(
    link: &mut HostLink,
    transport: &mut dyn Transport,
    clock: &dyn Fn() -> HostTime,
    rest: &mut dyn FnMut(),
    content: &mut dyn FnMut(u64, &mut [u8]),
    stop: &dyn Fn() -> bool,
    duration_ns: i64,
) -> Result<LinkMeasurement, LinkError> {
    assert!(link.state() == LinkState::Streaming, "link is {:?}", link.state());
    let slots = link.slots().expect("a streaming link is configured");
    let mut planes = vec![0; link.settings().raster.plane_bytes() * link.settings().schedule.len()];
    let first = link.status().copied();
    let before = link.counters();
    let start = clock();
    let mut next = link.next_frame_id();
    content(next, &mut planes);
    loop {
        let now = clock();
        if now.ns_since(start) >= duration_ns || stop() {
            break;
        }
        link.poll(now, transport)?;
        let device_now = link.status().map_or(DeviceTicks(0), |s| s.now);
        let slot = slots.slot_at(device_now).map_or(0, |k| k + 1);
        // The measurement counts arrivals, so late frames of a slow link are shown for as long as the device waits for
        // its host.
        let dark_from = slots.dark_from(slot, u64::from(link.settings().watchdog_us) * 1000);
        match link.send_frame(now, next, slots.start(slot), dark_from, &planes, transport) {
            SendOutcome::Sent => {
                next += 1;
                content(next, &mut planes);
            }
            SendOutcome::Dropped { reason: DropReason::LinkLost } => {}
            SendOutcome::Dropped { .. } => rest(),
        }
    }
    let now = clock();
    link.poll(now, transport)?;
    Ok(result(now.ns_since(start), before, link.counters(), first, link.status().copied()))
}

fn result(
    duration_ns: i64,
    a: LinkCounters,
    b: LinkCounters,
    first: Option<Status>,
    last: Option<Status>,
) -> LinkMeasurement {
    let frames_whole = match (first, last) {
        (Some(f), Some(l)) => u64::from(whole(&l).wrapping_sub(whole(&f))),
        _ => 0,
    };
    let frames_sent = b.frames_sent - a.frames_sent;
    LinkMeasurement {
        duration_ns,
        frames_sent,
        frames_whole,
        frames_per_s: frames_whole as f64 * 1e9 / duration_ns.max(1) as f64,
        bytes_per_frame: (b.frame_bytes_sent - a.frame_bytes_sent) as f64 / frames_sent.max(1) as f64,
        planes: [b.planes_raw - a.planes_raw, b.planes_coded - a.planes_coded, b.planes_kept - a.planes_kept],
        link_busy: b.link_busy - a.link_busy,
        no_credit: b.no_credit - a.no_credit,
    }
}
