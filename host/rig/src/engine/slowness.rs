//! Tells the operator when frames come for every n-th slot only, and who holds them up.

use dpm_device::time::HostTime;

/// Frames come too seldom from this many slots per frame on, in thousandths ...
const SLOW_MILLI: u64 = 1_500;
/// ... and often enough again below this many.
const QUICK_MILLI: u64 = 1_200;
/// Both must last so long before they are told, nanoseconds. One stall leaves out many slots and is no slow renderer.
const LASTS_NS: i64 = 500_000_000;

/// Whether frames come for every slot, as the operator knows it.
#[derive(Debug, Default)]
pub(super) struct Slowness {
    told: bool,
    /// Since when it has been otherwise.
    since: Option<HostTime>,
}

impl Slowness {
    /// Looks at the slots per frame, in thousandths, averaged over the last frames. What the operator is to be told at
    /// `now`: `Some(true)`, frames come for every n-th slot only; `Some(false)`, for each slot again.
    pub(super) fn observe(&mut self, stride_milli: u64, now: HostTime) -> Option<bool> {
        let is_otherwise = if self.told { stride_milli < QUICK_MILLI } else { stride_milli >= SLOW_MILLI };
        if !is_otherwise {
            self.since = None;
            return None;
        }
        if now.ns_since(*self.since.get_or_insert(now)) < LASTS_NS {
            return None;
        }
        (self.told, self.since) = (!self.told, None);
        Some(self.told)
    }
}

/// Threads that frames need got no core for such a share of the time: the machine is what holds frames up, in thousandths.
pub(super) const STARVED_MILLI: u64 = 400;

/// Who holds frames up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum SlowBy {
    /// The machine has too little processor time. A thread that frames need got no core for the first share of the time, some program
    /// of the machine for the second, in thousandths; 0 if that is not known.
    Machine { starved_milli: u64, pressure_milli: u64 },
    /// The GPU needs a slot or more for a frame.
    Renderer,
    /// Packing or the link.
    Rest,
}

/// The note to the operator of a projector with `hz` slots a second.
pub(super) fn told(is_slow: bool, stride_milli: u64, hz: f64, by: SlowBy) -> String {
    let every = stride_milli as f64 / 1e3;
    let rate = format!("one frame per {every:.1} slots, {:.1} of {hz:.1} per second", hz / every);
    match (is_slow, by) {
        (true, SlowBy::Machine { starved_milli, pressure_milli }) => {
            let all = match pressure_milli {
                0 => String::new(),
                milli => format!(", and some program of the machine in {} %", milli / 10),
            };
            format!(
                "the machine is short of processor time: {rate}; a thread that frames need was ready and got no core in {} % of the \
                 time{all}; end other programs, or let this one go first (real_time.priority)",
                starved_milli / 10
            )
        }
        (true, SlowBy::Renderer) => format!(
            "the renderer is slower than its slots: {rate}; a smaller raster, fewer samples (render.spp) or another method \
             make it faster"
        ),
        (true, SlowBy::Rest) => format!(
            "frames come for every n-th slot only, although the renderer would keep up: {rate}; packing or the link holds \
             them up, and the causes of missed slots and `dpm link-test` tell which"
        ),
        (false, _) => format!("each of {hz:.1} slots per second gets a frame"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lasts_is_told_once_and_a_stall_is_not() {
        let mut slowness = Slowness::default();
        let mut told = Vec::new();
        for ms in 0..10_000i64 {
            // A stall that the average over sixteen frames carries on for 40 ms, then three seconds of one frame in two slots,
            // with moments in which it is less.
            let stride = match ms {
                1000..1040 => 9_000,
                3000..6000 if ms % 1000 < 900 => 2_000,
                3000..6000 => 1_300,
                _ => 1_000,
            };
            told.extend(slowness.observe(stride, HostTime(ms * 1_000_000)).map(|is_slow| (ms, is_slow)));
        }
        assert_eq!(told, [(3500, true), (6500, false)]);
    }

    #[test]
    fn the_note_blames_the_renderer_only_where_it_is_slow() {
        let of = |by| super::told(true, 1_500, 947.0, by);
        assert!(of(SlowBy::Renderer)
            .starts_with("the renderer is slower than its slots: one frame per 1.5 slots, 631.3 of 947.0"));
        let rest = of(SlowBy::Rest);
        assert!(rest.contains("the renderer would keep up") && rest.contains("dpm link-test"));
        let starved = of(SlowBy::Machine { starved_milli: 730, pressure_milli: 900 });
        assert!(
            starved.contains("short of processor time")
                && starved.contains("73 %")
                && starved.contains("90 %")
        );
    }
}
