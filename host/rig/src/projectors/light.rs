//! How a projector lights the planes of a frame.

use dpm_common::words;

/// How the light of a frame is shared out over its exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlaneTiming {
    /// Every plane is lit equally long, with the light of its bit.
    Equal,
    /// Every plane is lit for as long as its bit weighs, always with the same light: an ALP with `weights = "binary"`.
    ByWeight,
    /// So many planes are lit together, as a number of as many bits, and the next ones after them: the patterns of a DLPC900.
    Together {
        /// Planes of a pattern.
        planes: u8,
    },
    /// There are no planes: code values are shown for the whole frame, by a display that is given them.
    Held,
}

words! {
    /// How much light the planes of a channel give.
    pub enum PlaneWeights {
        /// Half as much from plane to plane.
        Binary = "binary",
        /// All the same.
        Equal = "equal",
    }
}
