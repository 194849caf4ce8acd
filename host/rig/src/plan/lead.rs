//! Learns from the measured times between latch and sent how early a frame must begin, and when its slot must be
//! given up.
//!
//! The estimator keeps a histogram whose counts are halved from time to time: quantiles over the last seconds. One
//! long stall moves a quantile by one frame in thousands and is forgotten; a maximum or a mean would carry it into
//! every later frame. A reserve covers events that are rarer than the histogram's memory (an interrupt, a core lent
//! to another machine).
//!
//! Bins are a 32nd of a slot wide up to four slots. From there on each is a twelfth wider than the one before: a
//! renderer that needs many slots for a frame also needs a lead, and its frames are planned for slots that they can
//! meet.

/// Bins of equal width, each a 32nd of a slot.
const EVEN_BINS: usize = 128;
/// Slots that the even bins span.
const EVEN_SLOTS: i64 = 4;
/// Bins beyond them, each longer by [`GROWTH`]: 4 slots times 1.08^128 are about 76,000 slots.
const WIDE_BINS: usize = 128;
/// All bins.
const BINS: usize = EVEN_BINS + WIDE_BINS;
/// Upper edge of a wide bin divided by its lower edge.
const GROWTH: f64 = 1.08;
/// A time longer than this many typical times (and than [`EVEN_SLOTS`]) was not work but a stall, and no lead helps
/// against a stall ...
const STALL_TIMES: i64 = 4;
/// ... unless this many occur in a row: then the work itself has become that long.
const STALLS_IN_A_ROW: u32 = 8;
/// Counts are halved after about this many nanoseconds, so that the past weighs as much as the last two seconds ...
const MEMORY_NS: i64 = 2_163_000_000;
/// ... but never after more frames than this, and never after fewer than [`FEW`].
const HALVE_AFTER: u32 = 2048;
/// Share of frames that must be sent before their slot, in 1/10,000.
const IN_TIME: u64 = 9_995;
/// Share of frames, in 1/10,000, whose time decides when a slot is given up.
const TYPICAL: u64 = 9_000;
/// With fewer frames than this the first guess also counts.
const FEW: u32 = 256;
/// The same for frames that take longer than a slot: at a few frames per second the first guess would otherwise last
/// too long.
const FEW_SLOW: u32 = 32;

/// Quantiles of the time from latch to sent.
#[derive(Clone, Debug)]
pub struct LeadEstimator {
    bins: [u32; BINS],
    /// Upper edges of the bins, nanoseconds.
    edges: [i64; BINS],
    total: u32,
    since_halved: u32,
    slot_ns: i64,
    bin_ns: i64,
    first_guess_ns: i64,
    reserve_ns: i64,
    longest_wait_ns: i64,
    stalls: u64,
    stalls_in_a_row: u32,
}

impl LeadEstimator {
    /// For slots of `slot_ns` > 0. `first_guess_ns` is the lead until enough frames are measured. `reserve_ns` >= 0
    /// is added to the measured time. The lead exceeds the time of a typical frame by at most `longest_wait_ns`; a
    /// frame sent earlier would find no room in the device.
    pub fn new(slot_ns: i64, first_guess_ns: i64, reserve_ns: i64, longest_wait_ns: i64) -> Self {
        let slot_ns = slot_ns.max(1);
        let bin_ns = (slot_ns * EVEN_SLOTS / EVEN_BINS as i64).max(1);
        let mut edges = [0; BINS];
        for (i, edge) in edges.iter_mut().enumerate() {
            *edge = match i.checked_sub(EVEN_BINS) {
                None => (i as i64 + 1) * bin_ns,
                Some(wide) => ((EVEN_BINS as i64 * bin_ns) as f64 * GROWTH.powi(wide as i32 + 1)) as i64,
            };
        }
        Self {
            bins: [0; BINS],
            edges,
            total: 0,
            since_halved: 0,
            slot_ns,
            bin_ns,
            first_guess_ns: first_guess_ns.max(0),
            reserve_ns: reserve_ns.max(0),
            longest_wait_ns: longest_wait_ns.max(0),
            stalls: 0,
            stalls_in_a_row: 0,
        }
    }

    /// Records the time of one frame from the instant at which it should have been latched until it was sent,
    /// nanoseconds.
    pub fn measured(&mut self, needed_ns: i64) {
        let needed_ns = needed_ns.max(0);
        let usual = (self.slot_ns * EVEN_SLOTS).max(self.typical_ns().saturating_mul(STALL_TIMES));
        if needed_ns >= usual {
            self.stalls += 1;
            self.stalls_in_a_row += 1;
            if self.stalls_in_a_row < STALLS_IN_A_ROW {
                return;
            }
        } else {
            self.stalls_in_a_row = 0;
        }
        let bin = self.edges.partition_point(|&edge| edge <= needed_ns);
        let Some(bin) = self.bins.get_mut(bin) else { return };
        *bin += 1;
        self.total += 1;
        self.since_halved += 1;
        let remembered =
            (MEMORY_NS / self.typical_ns().max(self.slot_ns)).clamp(i64::from(FEW), i64::from(HALVE_AFTER));
        if i64::from(self.since_halved) >= remembered {
            self.since_halved = 0;
            // Rounded down, so that a single event is forgotten.
            self.bins.iter_mut().for_each(|n| *n /= 2);
            self.total = self.bins.iter().sum();
        }
    }

    /// How long before its slot a frame is latched so that nearly all are sent in time.
    pub fn lead_ns(&self) -> i64 {
        let quantile = self.quantile(IN_TIME);
        let measured = (quantile + self.bin_ns).saturating_add(self.reserve_ns);
        let few = if quantile > self.slot_ns { FEW_SLOW } else { FEW };
        let lead = if self.total < few { measured.max(self.first_guess_ns) } else { measured };
        lead.min(self.needed_ns().saturating_add(self.longest_wait_ns))
    }

    /// The time that most frames need; the first guess while nothing has been measured.
    fn needed_ns(&self) -> i64 {
        if self.total == 0 {
            self.first_guess_ns
        } else {
            self.quantile(TYPICAL)
        }
    }

    /// The time that most frames need: a slot that begins earlier than this from now is given up for the next one.
    pub fn typical_ns(&self) -> i64 {
        self.needed_ns().min(self.lead_ns())
    }

    /// Frames that took so long that no lead could have helped.
    #[cfg(test)]
    pub(crate) fn stalls(&self) -> u64 {
        self.stalls
    }

    /// Upper edge of the bin in which the quantile lies; 0 without measurements.
    fn quantile(&self, ten_thousandths: u64) -> i64 {
        let wanted = (u64::from(self.total) * ten_thousandths).div_ceil(10_000);
        let mut seen = 0;
        for (edge, &n) in self.edges.iter().zip(&self.bins) {
            seen += u64::from(n);
            if n > 0 && seen >= wanted {
                return *edge;
            }
        }
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SLOT: i64 = 1_055_966;

    fn estimator() -> LeadEstimator {
        LeadEstimator::new(SLOT, 2 * SLOT, 0, 2 * SLOT)
    }

    /// A reproducible number between 0 and 1.
    fn noise(i: u64) -> f64 {
        (i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 11) as f64 / (1u64 << 53) as f64
    }

    #[test]
    fn the_first_guess_gives_way_to_what_is_measured() {
        let mut e = estimator();
        assert_eq!(e.lead_ns(), 2 * SLOT);
        for i in 0..FEW {
            e.measured(300_000 + i64::from(i));
        }
        assert!((300_000..400_000).contains(&e.lead_ns()), "{}", e.lead_ns());
        assert!(e.typical_ns() <= e.lead_ns() && e.typical_ns() >= 300_000);
    }

    /// At any steady load, the lead covers all of the last frames except one in two thousand.
    #[test]
    fn the_lead_covers_what_it_promises() {
        let mut e = estimator();
        let needs = |i: u64| (200_000.0 + 600_000.0 * noise(i).powi(4)) as i64;
        for i in 0..20_000 {
            e.measured(needs(i));
        }
        let lead = e.lead_ns();
        let late = (20_000..40_000).filter(|&i| needs(i) > lead).count();
        assert!(late <= 20, "{late} of 20000 beyond a lead of {lead} ns");
        assert!(lead < 800_000 + 3 * e.bin_ns, "{lead} ns for needs of at most 0.8 ms");
        let slow = (20_000..40_000).filter(|&i| needs(i) > e.typical_ns()).count();
        assert!(slow <= 2_200, "{slow} of 20000 beyond the typical {} ns", e.typical_ns());
    }

    #[test]
    fn the_reserve_comes_on_top_of_what_is_measured_and_ends_where_the_device_has_no_room() {
        let (mut with, mut without) = (LeadEstimator::new(SLOT, 0, SLOT / 2, SLOT / 4), estimator());
        for ns in [400_000, 1_900_000] {
            for _ in 0..10_000 {
                with.measured(ns);
                without.measured(ns);
            }
            let (lead, bare) = (with.lead_ns(), without.lead_ns());
            // No frame waits in the device for longer than the device has room for it.
            assert!(bare >= ns && (bare..=bare + SLOT / 4).contains(&lead), "{lead}, {bare}");
            assert_eq!(
                with.typical_ns(),
                without.typical_ns(),
                "when a slot is given up is not what is kept in reserve"
            );
        }
    }

    #[test]
    fn a_stall_changes_nothing() {
        let mut e = estimator();
        for i in 0..5_000 {
            e.measured(300_000 + (noise(i) * 1e5) as i64);
        }
        let before = (e.lead_ns(), e.typical_ns());
        // 100 ms: the frame in progress and those behind it.
        for waiting in [100_000_000, 99_000_000, 98_000_000] {
            e.measured(waiting);
        }
        assert_eq!(((e.lead_ns(), e.typical_ns()), e.stalls()), (before, 3));
    }

    /// The lead follows a rising load within a second and forgets a past load within some seconds.
    #[test]
    fn a_changed_load_is_followed() {
        let mut e = estimator();
        let feed = |e: &mut LeadEstimator, n: u64, ns: i64| (0..n).for_each(|_| e.measured(ns));
        feed(&mut e, 10_000, 300_000);
        assert!(e.lead_ns() < 400_000);
        feed(&mut e, 10, 1_500_000);
        assert!(e.lead_ns() >= 1_500_000, "{}", e.lead_ns());
        feed(&mut e, 15_000, 300_000);
        assert!(e.lead_ns() < 400_000, "{}", e.lead_ns());
    }

    /// Found in use, R21: a renderer that needs many slots for a frame gets a lead that it can keep, from its first
    /// frames on.
    #[test]
    fn a_renderer_slower_than_its_slots_has_a_lead_that_it_can_keep() {
        let slot = 16_666_667;
        let mut e = LeadEstimator::new(slot, 2_270_000, 500_000, 2 * slot);
        let needs = |i: u64| 60_000_000 + (noise(i) * 12e6) as i64;
        for i in 0..STALLS_IN_A_ROW as u64 + 32 {
            e.measured(needs(i));
        }
        let late = (1000..2000).filter(|&i| needs(i) > e.lead_ns()).count();
        assert!(late <= 30, "{late} of 1000 beyond a lead of {} ns", e.lead_ns());
        assert!(e.lead_ns() < 85_000_000, "{} ns for needs of at most 72 ms", e.lead_ns());
        // Faster again: the old times are forgotten within half a minute at 60 frames per second.
        for _ in 0..1800 {
            e.measured(10_000_000);
        }
        assert!(e.lead_ns() < 13_000_000, "{} ns for needs of 10 ms", e.lead_ns());
    }

    proptest! {
        #[test]
        fn any_measurement_leaves_it_in_bounds(ns in prop::collection::vec(any::<i64>(), 0..600)) {
            let mut e = estimator();
            for ns in ns {
                e.measured(ns);
                prop_assert!(e.lead_ns() >= 0);
                prop_assert!((0..=e.lead_ns()).contains(&e.typical_ns()));
            }
        }
    }
}
