//! Why coded light before a camera does not make a projector, and what the operator should do about it.

use thiserror::Error;

/// Why a view is refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ViewRefusal {
    /// A number is NaN or infinite, or a deviation is not above 0.
    #[error("projector: ray {0} is not finite; leave it out")]
    NotFinite(usize),
    /// The camera sees too little of the light.
    #[error("projector: too little light: {have} pixels of the camera saw the code, {need} are needed; darken the room, open the lens, expose longer, or put something bright into the beam")]
    TooFew {
        /// Pixels that saw the code.
        have: usize,
        /// Pixels needed.
        need: usize,
    },
    /// Nothing of known size is lit.
    #[error("projector: nothing of known size is lit ({have} of {need} pixels lie on tags): put a body with tags or the printed board into camera's view and projector's beam")]
    NoScale {
        /// Pixels on tags.
        have: usize,
        /// Pixels needed.
        need: usize,
    },
    /// The camera sees a part of the picture only.
    #[error("projector: the camera sees {percent:.0} % of the picture's width or height, {need:.0} % are needed; let it see more of the light")]
    Corner {
        /// Share seen, percent.
        percent: f64,
        /// Share needed.
        need: f64,
    },
    /// Everything lies in one plane.
    #[error("projector: a plane only: all that was lit lies in a plane, up to {off_plane_px:.1} pixels; lens and distance cannot be told apart: put a body, or the board at a slant, before the wall")]
    PlaneOnly {
        /// How far pixels lie from those of a plane, root mean square.
        off_plane_px: f64,
    },
    /// The camera or the things in view moved.
    #[error("projector: the camera moved: the picture after the codes is {moved_px:.2} px off the one before them; fix the camera, and begin again")]
    CameraMoved {
        /// How far, pixels.
        moved_px: f64,
    },
    /// Something in view moved.
    #[error("projector: something in view moved by {moved_px:.2} px during the codes; let everything rest, and begin again")]
    SceneMoved {
        /// How far, pixels.
        moved_px: f64,
    },
    /// Nothing explains the rays.
    #[error("projector: no projector explains what the camera saw (residual {rms_px:.2} px): something moved during the codes, or the camera's calibration is wrong; check `dpm calibrate camera`, and begin again")]
    NoSolution {
        /// Residual, pixels.
        rms_px: f64,
    },
    /// The lens of the solution folds inside the raster.
    #[error("projector: the lens that fits cannot be inverted over the raster; let the camera see all of the picture")]
    LensFolds,
    /// The light would be too uncertain.
    #[error("projector: the light would be uncertain by {p99_px:.1} px (99th percentile over what was lit), at most {most_px} px are accepted; put more things at different distances into the beam, and a larger board")]
    Uncertain {
        /// Predicted error, pixels.
        p99_px: f64,
        /// The bound.
        most_px: f64,
    },
}
