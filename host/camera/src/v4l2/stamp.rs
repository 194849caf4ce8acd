//! What the stamp of a buffer says of the exposure.

use super::abi::{STAMP_AT_BEGIN, STAMP_AT_END, STAMP_CLOCK, STAMP_COPIED, STAMP_MOMENT, STAMP_MONOTONIC};

/// A stamp that lies farther in the future is of another clock, ns. Drivers that convert the device's own clock err by less.
const MOST_AHEAD_NS: i64 = 20_000_000;
/// A stamp that is older is of another clock, ns.
const MOST_OLD_NS: i64 = 2_000_000_000;

/// What was stamped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Moment {
    /// The begin of the exposure.
    Begin,
    /// The end of the picture: its last row has been read.
    End,
}

impl Moment {
    /// For messages.
    pub(super) fn told(self) -> &'static str {
        match self {
            Self::Begin => "the begin of the exposure",
            Self::End => "the end of the picture",
        }
    }

    /// The begin of the exposure of the first row, for a picture that was stamped with `stamp_ns`.
    pub(super) fn begin_ns(self, stamp_ns: i64, exposure_ns: i64, readout_ns: i64) -> i64 {
        match self {
            Self::Begin => stamp_ns,
            Self::End => stamp_ns.saturating_sub(exposure_ns).saturating_sub(readout_ns),
        }
    }
}

/// What the flags of a buffer say of its stamp, which was read at `now_ns` of CLOCK_MONOTONIC.
///
/// # Errors
/// The clock or the moment is unknown, or the stamp cannot be of the clock that the flags name.
pub(super) fn moment(flags: u32, stamp_ns: i64, now_ns: i64) -> Result<Moment, String> {
    match flags & STAMP_CLOCK {
        STAMP_MONOTONIC => {}
        STAMP_COPIED => {
            return Err(
                "its stamps were copied from another program, and do not say when a picture was exposed"
                    .into(),
            )
        }
        0 => return Err("its driver does not say by which clock it stamps".into()),
        other => return Err(format!("its driver stamps by a clock that is not known ({other:#x})")),
    }
    let moment = match flags & STAMP_MOMENT {
        STAMP_AT_BEGIN => Moment::Begin,
        STAMP_AT_END => Moment::End,
        other => return Err(format!("its driver stamps a moment that is not known ({other:#x})")),
    };
    let age_ns = now_ns.saturating_sub(stamp_ns);
    if (-MOST_AHEAD_NS..=MOST_OLD_NS).contains(&age_ns) {
        return Ok(moment);
    }
    Err(format!(
        "its stamps lie {:.3} s before now and cannot be of CLOCK_MONOTONIC, which its driver names",
        1e-9 * age_ns as f64
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_stamps_of_the_known_clock_and_of_known_moments_count() {
        let now = 50_000_000_000;
        assert_eq!(moment(STAMP_MONOTONIC | STAMP_AT_BEGIN, now - 1_000_000, now), Ok(Moment::Begin));
        assert_eq!(moment(STAMP_MONOTONIC | STAMP_AT_END, now + 1_000_000, now), Ok(Moment::End));
        for flags in [0, STAMP_AT_BEGIN, STAMP_COPIED, 0x6000, 0x8000, STAMP_MONOTONIC | 0x2_0000] {
            assert!(moment(flags, now, now).is_err(), "{flags:#x}");
        }
        // uvcvideo with clock=realtime says CLOCK_MONOTONIC.
        for stamp in [1_700_000_000_000_000_000, now + 21_000_000, now - 2_000_000_001, i64::MIN, i64::MAX] {
            assert!(moment(STAMP_MONOTONIC, stamp, now).unwrap_err().contains("CLOCK_MONOTONIC"), "{stamp}");
        }
    }

    #[test]
    fn an_end_lies_behind_exposure_and_readout() {
        assert_eq!(Moment::Begin.begin_ns(100, 30, 20), 100);
        assert_eq!(Moment::End.begin_ns(100, 30, 20), 50);
    }
}
