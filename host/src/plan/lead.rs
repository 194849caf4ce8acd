//! Measured times from latch to sent into how early a frame must be begun, and when its slot must be given up.
//!
//! A histogram whose counts are halved now and then: quantiles over the last seconds. One long stall moves a quantile by one
//! frame in thousands and is forgotten; a maximum, or a mean, would carry it into every frame after. What comes less often than
//! the histogram remembers (an interrupt, a core lent to another machine) is met by a reserve.

/// Bins of the histogram, each a 32nd of a slot: times up to [`HORIZON_SLOTS`].
const BINS: usize = 128;
/// Slots that the histogram spans. What took longer was no work but a stall, against which no lead helps.
const HORIZON_SLOTS: i64 = 4;
/// Counts are halved after this many frames: the past weighs as much as the last two seconds at 947 Hz.
const HALVE_AFTER: u32 = 2048;
/// Share of frames that must be sent before their slot, in ten thousandths.
const IN_TIME: u64 = 9_995;
/// Share of frames that need no longer than what a slot is given up for.
const TYPICAL: u64 = 9_000;
/// Frames below which the first guess counts as well.
const FEW: u32 = 256;

/// Quantiles of the time from latch to sent.
#[derive(Clone, Debug)]
pub struct LeadEstimator {
    bins: [u32; BINS],
    total: u32,
    since_halved: u32,
    bin_ns: i64,
    first_guess_ns: i64,
    reserve_ns: i64,
    longest_ns: i64,
    stalls: u64,
}

impl LeadEstimator {
    /// For slots of `slot_ns` > 0. `first_guess_ns` is the lead until enough frames are measured, `reserve_ns` >= 0 is added to what is
    /// measured; no lead is above `longest_ns`: what is sent earlier would find no room in the device.
    pub fn new(slot_ns: i64, first_guess_ns: i64, reserve_ns: i64, longest_ns: i64) -> Self {
        let bin_ns = (slot_ns.max(1) * HORIZON_SLOTS / BINS as i64).max(1);
        let first_guess_ns = first_guess_ns.clamp(0, longest_ns);
        Self {
            bins: [0; BINS],
            total: 0,
            since_halved: 0,
            bin_ns,
            first_guess_ns,
            reserve_ns: reserve_ns.max(0),
            longest_ns,
            stalls: 0,
        }
    }

    /// Takes in what one frame needed from the instant at which it should have been latched until it was sent, nanoseconds.
    pub fn measured(&mut self, needed_ns: i64) {
        let Some(bin) = self.bins.get_mut((needed_ns.max(0) / self.bin_ns) as usize) else {
            self.stalls += 1;
            return;
        };
        *bin += 1;
        self.total += 1;
        self.since_halved += 1;
        if self.since_halved >= HALVE_AFTER {
            self.since_halved = 0;
            // Rounded down: what happened once is forgotten.
            self.bins.iter_mut().for_each(|n| *n /= 2);
            self.total = self.bins.iter().sum();
        }
    }

    /// How long before its slot a frame is latched so that nearly all are sent in time.
    pub fn lead_ns(&self) -> i64 {
        let measured = (self.quantile(IN_TIME) + self.bin_ns).saturating_add(self.reserve_ns);
        let lead = if self.total < FEW { measured.max(self.first_guess_ns) } else { measured };
        lead.min(self.longest_ns)
    }

    /// What most frames need: a slot that begins earlier than this from now is given up for the next.
    pub fn typical_ns(&self) -> i64 {
        self.quantile(TYPICAL).min(self.lead_ns())
    }

    /// Frames that took longer than any lead could mend.
    pub fn stalls(&self) -> u64 {
        self.stalls
    }

    /// Upper edge of the bin in which the quantile lies; 0 without measurements.
    fn quantile(&self, ten_thousandths: u64) -> i64 {
        let wanted = (u64::from(self.total) * ten_thousandths).div_ceil(10_000);
        let mut seen = 0;
        for (i, &n) in self.bins.iter().enumerate() {
            seen += u64::from(n);
            if n > 0 && seen >= wanted {
                return (i as i64 + 1) * self.bin_ns;
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
        LeadEstimator::new(SLOT, 2 * SLOT, 0, 3 * SLOT)
    }

    /// A reproducible number from 0 to 1.
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

    /// All of the last frames but one in two thousand are covered, at any steady load.
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
    fn the_reserve_comes_on_top_of_what_is_measured_and_ends_at_the_longest() {
        let (mut with, mut without) = (LeadEstimator::new(SLOT, 0, SLOT / 2, 2 * SLOT), estimator());
        for (ns, expected) in [(400_000, 400_000), (1_900_000, 2 * SLOT - SLOT / 2)] {
            for _ in 0..10_000 {
                with.measured(ns);
                without.measured(ns);
            }
            let (lead, bare) = (with.lead_ns(), without.lead_ns());
            assert!(lead == (bare + SLOT / 2).min(2 * SLOT) && bare >= expected, "{lead}, {bare}");
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
        // 100 ms: the frame in hand and those behind it.
        for waiting in [100_000_000, 99_000_000, 98_000_000] {
            e.measured(waiting);
        }
        assert_eq!(((e.lead_ns(), e.typical_ns()), e.stalls()), (before, 3));
    }

    /// Load that comes is answered within a second; load that went is forgotten within some seconds.
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

    proptest! {
        #[test]
        fn any_measurement_leaves_it_in_bounds(ns in prop::collection::vec(any::<i64>(), 0..600)) {
            let mut e = estimator();
            for ns in ns {
                e.measured(ns);
                prop_assert!((0..=3 * SLOT).contains(&e.lead_ns()));
                prop_assert!((0..=e.lead_ns()).contains(&e.typical_ns()));
            }
        }
    }
}
