//! A window of an X server as what shows a panel's pictures, for a desk without a projector. Under Wayland the window is
//! one of Xwayland.
//!
//! The extension Present paces it: the server shows a picture from a vertical blank on, and tells the count and the instant
//! of that blank. A compositor may show it a frame later than that, and may change its pixels.

#[cfg(feature = "x11")]
mod desk;
#[cfg(feature = "x11")]
mod x11;

use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::FrameRate;

#[cfg(feature = "x11")]
pub use x11::{look, opener, X11Window};

/// What a rig file says of its window.
#[derive(Clone, Debug)]
pub struct WindowSettings {
    /// The X server, as in `DISPLAY`; that variable if `None`.
    pub server: Option<String>,
    /// The monitor that the window fills; an ordinary window if `None`.
    pub monitor: Option<String>,
    /// From the choice of a frame to its vertical blank, nanoseconds.
    pub commit_ns: i64,
    /// The rig's raster: the window's pixels.
    pub raster: Raster,
    /// The rig's planes.
    pub schedule: PlaneSchedule,
    /// The rig's frame rate, within one percent that of the monitor.
    pub rate: FrameRate,
}

/// Ends this program as Ctrl+C does.
pub fn interrupt_program() {
    let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::INT);
}

/// The opener of a window in a program that was built without X11: it refuses.
#[cfg(not(feature = "x11"))]
pub fn opener(_: WindowSettings, _: impl Fn() + Send + Sync + 'static) -> crate::transport::Opener {
    std::sync::Arc::new(|| Err(left_out()))
}

/// The same without an opener.
///
/// # Errors
/// Always: no window can be shown.
#[cfg(not(feature = "x11"))]
pub fn look(_: &WindowSettings) -> Result<(), dpm_device::transport::TransportError> {
    Err(left_out())
}

#[cfg(not(feature = "x11"))]
fn left_out() -> dpm_device::transport::TransportError {
    let why = "this program was built without its feature \"x11\", which shows windows; build it with that feature, \
               or choose another projector.backend.kind";
    dpm_device::transport::TransportError::Unsuitable { device: "window".into(), why: why.into() }
}

#[cfg(all(test, not(feature = "x11")))]
mod tests {
    use super::*;

    #[test]
    fn a_window_is_refused_by_name_in_a_program_without_x11() {
        let settings = WindowSettings {
            server: None,
            monitor: None,
            commit_ns: 1_000_000,
            raster: Raster::new(64, 48).unwrap(),
            schedule: PlaneSchedule::rgb24(),
            rate: FrameRate::new(60, 1).unwrap(),
        };
        let told = opener(settings, || ())().err().expect("refused").to_string();
        assert!(told.contains("window") && told.contains("built without its feature \"x11\""), "{told}");
    }
}
