//! How a projector lights the planes of a frame.

use dpm_common::words;
use dpm_device::time::FrameRate;

/// How the light of a frame is shared out over its exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlaneTiming {
    /// Every plane is lit equally long, with the light of its bit.
    Equal,
    /// Every plane is lit for as long as its bit weighs, always with the same light: an ALP with `plane_times = "binary"`.
    ByWeight,
    /// So many planes are lit together, as a number of as many bits, and the next ones after them: the patterns of a DLPC900.
    Together {
        /// Planes of a pattern.
        planes: u8,
    },
    /// All planes of a channel are lit together, as a number of as many bits, and the next channel after them: red, green, blue,
    /// white. The loaded patterns of a DLPC900.
    ByChannel,
    /// There are no planes: code values are shown for the whole frame, by a display that is given them.
    Held,
}

/// Which part of a frame its planes take: patterns of one or more planes follow one another from the first photon on, each
/// lit and then dark, and what is left of the frame is dark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LitTime {
    /// All patterns with their dark times, nanoseconds; above 0.
    pub whole_ns: i64,
    /// The dark time at the end of each pattern, nanoseconds; 0 where planes last as long as they weigh.
    pub dark_ns: i64,
    /// The frame, nanoseconds.
    pub frame_ns: i64,
}

impl LitTime {
    /// Light without a gap.
    pub fn all_of(rate: FrameRate) -> Self {
        let frame_ns = rate.slot_len_ns(0);
        Self { whole_ns: frame_ns, dark_ns: 0, frame_ns }
    }
}

words! {
    /// How much light the planes of a channel give.
    pub enum PlaneWeights {
        /// Half as much from plane to plane.
        Binary = "binary",
        /// All the same.
        Equal = "equal",
        /// Half as much from plane to plane, but for the highest bit, which three planes of equal light show.
        Split = "split",
        /// Split where the projector offers it and nothing was measured with other planes, else binary.
        Auto = "auto",
    }
}

impl PlaneWeights {
    /// True if three planes show the highest bit. [`PlaneWeights::Auto`] counts: of a configuration that was accepted it is left
    /// only where nothing but the projector can forbid it.
    pub fn are_split(self) -> bool {
        matches!(self, Self::Split | Self::Auto)
    }
}
