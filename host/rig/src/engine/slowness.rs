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

/// The note to the operator of a projector with `hz` slots a second. `by_gpu`: the GPU needs a slot or more for a frame.
pub(super) fn told(is_slow: bool, stride_milli: u64, hz: f64, by_gpu: bool) -> String {
    let every = stride_milli as f64 / 1e3;
    let rate = format!("one frame per {every:.1} slots, {:.1} of {hz:.1} per second", hz / every);
    match (is_slow, by_gpu) {
        (true, true) => format!(
            "the renderer is slower than its slots: {rate}; a smaller raster, fewer samples (render.spp) or another method \
             make it faster"
        ),
        (true, false) => format!(
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
        let of = |by_gpu| super::told(true, 1_500, 947.0, by_gpu);
        assert!(of(true)
            .starts_with("the renderer is slower than its slots: one frame per 1.5 slots, 631.3 of 947.0"));
        assert!(of(false).contains("the renderer would keep up") && of(false).contains("dpm link-test"));
    }
}
