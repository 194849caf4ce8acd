//! What the link carries, while it does: the link's thread writes numbers, and observers read them as the report has
//! them.

use super::projector::{DeviceCounts, ProjectorReport};
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

/// The figures of a [`ProjectorReport`]. Writing them takes no lock and allocates nothing. Accesses are relaxed: each
/// number is right, but they are not all of one instant.
#[derive(Debug, Default)]
pub(crate) struct LinkGauges {
    /// Sessions, returns of the light, bytes, planes (3), TRACKS, planes that they moved (3), frames not sent (6).
    counts: [AtomicU64; 16],
    /// What the projector counted.
    device: [AtomicU64; 9],
    /// Bound of the clock's error and the learned travel, nanoseconds; [`NONE`] while there is none.
    times_ns: [Time; 2],
    /// The device's hottest sensor, thousandths of a degree Celsius; [`NONE`] while there is none.
    milli_celsius: Time,
    /// 1 once the projector has counted something.
    has_device: AtomicU64,
}

/// A number that is not known.
const NONE: i64 = i64::MIN;

#[derive(Debug)]
struct Time(AtomicI64);

impl Default for Time {
    fn default() -> Self {
        Self(AtomicI64::new(NONE))
    }
}

/// What the link's thread tells.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LinkReport {
    /// Sessions opened.
    pub sessions: u64,
    /// Times that light came back by itself.
    pub rearmed: u64,
    /// Bytes handed to the medium.
    pub bytes_sent: u64,
    /// Planes raw, coded and kept.
    pub planes: [u64; 3],
    /// Frames not sent, in the order of [`ProjectorReport::not_sent`].
    pub not_sent: [u64; 6],
    /// TRACKS sent.
    pub tracks_sent: u64,
    /// Planes by what tracks did, in the order of [`ProjectorReport::planes_by_tracks`].
    pub planes_by_tracks: [u64; 3],
    /// What the projector counted; `None` for the mock in this process.
    pub device: Option<DeviceCounts>,
    /// Bound of the clock's error, nanoseconds.
    pub clock_bound_ns: Option<i64>,
    /// Learned time from sent to light, nanoseconds.
    pub travel_ns: Option<i64>,
    /// The device's hottest sensor, thousandths of a degree Celsius.
    pub milli_celsius: Option<i32>,
}

impl LinkGauges {
    /// Writes all figures.
    pub(crate) fn tell(&self, c: &LinkReport) {
        let counts = [c.sessions, c.rearmed, c.bytes_sent].into_iter().chain(c.planes);
        let counts = counts.chain([c.tracks_sent]).chain(c.planes_by_tracks).chain(c.not_sent);
        self.counts.iter().zip(counts).for_each(|(to, n)| to.store(n, Ordering::Relaxed));
        if let Some(d) = c.device {
            let DeviceCounts { lit, lit_unseen, repeated, blank, incomplete, .. } = d;
            let DeviceCounts { too_late, superseded, refused, damaged_packets, .. } = d;
            let all = [
                lit,
                lit_unseen,
                repeated,
                blank,
                incomplete,
                too_late,
                superseded,
                refused,
                damaged_packets,
            ];
            self.device.iter().zip(all).for_each(|(to, n)| to.store(n, Ordering::Relaxed));
            self.has_device.store(1, Ordering::Relaxed);
        }
        for (to, time) in self.times_ns.iter().zip([c.clock_bound_ns, c.travel_ns]) {
            to.0.store(time.unwrap_or(NONE), Ordering::Relaxed);
        }
        self.milli_celsius.0.store(c.milli_celsius.map_or(NONE, i64::from), Ordering::Relaxed);
    }

    /// Frames that the projector has lit by its own count; 0 for the mock in this process.
    pub(crate) fn lit_by_device(&self) -> u64 {
        self.device[0].load(Ordering::Relaxed)
    }

    /// The figures as a report, with the name of the medium.
    pub(crate) fn report(&self, name: &str) -> ProjectorReport {
        let [sessions, rearmed, bytes, raw, coded, kept, tracks_sent, moved, clamped, stale, not_sent @ ..] =
            self.counts.each_ref().map(|n| n.load(Ordering::Relaxed));
        let [lit, lit_unseen, repeated, blank, incomplete, too_late, superseded, refused, damaged_packets] =
            self.device.each_ref().map(|n| n.load(Ordering::Relaxed));
        let [clock_bound_ns, travel_ns] = self
            .times_ns
            .each_ref()
            .map(|time| Some(time.0.load(Ordering::Relaxed)).filter(|ns| *ns != NONE));
        let device = DeviceCounts {
            lit,
            lit_unseen,
            repeated,
            blank,
            incomplete,
            too_late,
            superseded,
            refused,
            damaged_packets,
        };
        ProjectorReport {
            name: name.to_owned(),
            sessions,
            rearmed,
            sent_mb: bytes as f64 / 1e6,
            planes: [raw, coded, kept],
            not_sent,
            tracks_sent,
            planes_by_tracks: [moved, clamped, stale],
            device: (self.has_device.load(Ordering::Relaxed) != 0).then_some(device),
            clock_bound_ns,
            travel_ms: travel_ns.map(|ns| ns as f64 / 1e6),
            slack: None,
            touches: None,
            celsius: Some(self.milli_celsius.0.load(Ordering::Relaxed))
                .filter(|c| *c != NONE)
                .map(|c| c as f64 / 1e3),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_figure_comes_out_where_it_went_in() {
        let gauges = LinkGauges::default();
        let empty = gauges.report("x");
        assert_eq!((empty.device, empty.clock_bound_ns), (None, None));
        assert_eq!((empty.travel_ms, empty.celsius), (None, None));
        let device = DeviceCounts {
            lit: 21,
            lit_unseen: 22,
            repeated: 23,
            blank: 24,
            incomplete: 25,
            too_late: 26,
            superseded: 27,
            refused: 28,
            damaged_packets: 29,
        };
        gauges.tell(&LinkReport {
            sessions: 1,
            rearmed: 2,
            bytes_sent: 3_000_000,
            planes: [4, 5, 6],
            not_sent: [7, 8, 9, 10, 11, 12],
            tracks_sent: 15,
            planes_by_tracks: [16, 17, 18],
            device: Some(device),
            clock_bound_ns: Some(-13),
            travel_ns: Some(14_000_000),
            milli_celsius: Some(41_500),
        });
        let told = gauges.report("usb");
        assert_eq!(
            told,
            ProjectorReport {
                name: "usb".into(),
                sessions: 1,
                rearmed: 2,
                sent_mb: 3.0,
                planes: [4, 5, 6],
                not_sent: [7, 8, 9, 10, 11, 12],
                tracks_sent: 15,
                planes_by_tracks: [16, 17, 18],
                device: Some(device),
                clock_bound_ns: Some(-13),
                travel_ms: Some(14.0),
                slack: None,
                touches: None,
                celsius: Some(41.5),
            }
        );
    }
}
