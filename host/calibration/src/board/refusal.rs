//! Why views of a board do not make a camera, and what the operator should do about it.

use thiserror::Error;

/// Why views are refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum BoardRefusal {
    /// Too few views that show enough of the board.
    #[error(
        "camera: {have} views of the board are too few, {need} are needed; hold it still at more places"
    )]
    TooFew {
        /// Views there are.
        have: usize,
        /// Views needed.
        need: usize,
    },
    /// A number is NaN or infinite, or a deviation is not above 0.
    #[error("camera: view {view} has a number that is not finite; leave it out")]
    NotFinite {
        /// Index of the view.
        view: usize,
    },
    /// The board was seen in the middle of the picture only.
    #[error("camera: the board was seen up to {share:.0} % of the way from the middle of the picture to its corners, and {need:.0} % are needed; hold it into the corners")]
    MiddleOnly {
        /// How far points reach, percent.
        share: f64,
        /// How far they must reach.
        need: f64,
    },
    /// The board was never turned.
    #[error("camera: all views show the board at one tilt, within {degrees:.0} degrees: focal length and distance cannot be told apart; turn the board by 20 to 45 degrees, to the left, to the right, up and down")]
    OneTilt {
        /// The largest angle between two views.
        degrees: f64,
    },
    /// The points lie on no such board.
    #[error("camera: the corners lie {rms_px:.2} px off any flat board of this size; is it the board that `dpm calibrate camera --print` made, at the paper's size that was told, and was it held still?")]
    NoBoard {
        /// Residual, pixels.
        rms_px: f64,
    },
    /// The board bulges.
    #[error("camera: the board is not flat: it bulges by {bend_mm:.1} mm; fix the sheet to a plate of glass, wood or aluminium, and begin again")]
    NotFlat {
        /// Bulge, millimetres.
        bend_mm: f64,
    },
    /// The printer scaled width and height differently.
    #[error("camera: the print is {percent:.1} % wider than it is high; print it at 100 %, without \"fit to page\", and begin again")]
    Stretched {
        /// Width over height less 1, percent.
        percent: f64,
    },
    /// The lens of the solution folds inside the picture.
    #[error("camera: the lens that fits cannot be inverted over the picture: hold the board into the corners, too; fish-eye lenses are not supported")]
    LensFolds,
    /// The camera would be too uncertain.
    #[error("camera: directions would be uncertain by {p99_px:.1} px (99th percentile over the picture), at most {most_px} px are accepted; take more views, nearer, tilted more, and in the corners")]
    Uncertain {
        /// Predicted error, pixels.
        p99_px: f64,
        /// The bound.
        most_px: f64,
    },
}
