//! What a panel needs of what shows its pictures: pictures in turn, and when each was taken. A graphics card is one
//! ([`crate::card::Card`]), a window is another ([`crate::window`]), and tests have [`crate::fake::FakeKms`].

use std::ffi::OsString;
use std::io;
use std::os::fd::OwnedFd;

use dpm_device::transport::TransportError;

/// One of the three pictures in the display's memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureBuffer {
    /// The one that is black and stays black.
    Black,
    /// One of the two that frames are written to, 0 or 1.
    Frame(usize),
}

/// The memory of a picture for frames.
pub struct Pixels<'a> {
    /// Rows of `pitch` bytes, XRGB8888.
    pub bytes: &'a mut [u8],
    /// Bytes from row to row.
    pub pitch: usize,
}

/// A picture has been taken: it is scanned out from here on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Flip {
    /// The count of vertical blanks. It wraps.
    pub sequence: u32,
    /// When the first pixel of the picture was sent, on the clock of [`ScanOut::now_ns`].
    pub at_ns: i64,
}

/// Why a display cannot be used, or is used no longer.
#[derive(Debug, thiserror::Error)]
pub enum DisplayError {
    /// The display or its card is gone.
    #[error("the display is unplugged or switched off")]
    Gone,
    /// What was lent is lent no longer.
    #[error(
        "the desktop has taken the display back, or has let go of the graphics card itself (another console, the end of the \
         session)"
    )]
    Revoked,
    /// Somebody closed the window.
    #[error("its window was closed")]
    Closed,
    /// The last picture has not been taken yet.
    #[error("the last picture has not been taken yet")]
    Busy,
    /// No such card.
    #[error("{0}: no such graphics card; `ls /dev/dri` lists them")]
    NoCard(String),
    /// This user may not open the card.
    #[error("{0}: permission denied; add the user to the group \"video\", and log in again")]
    Denied(String),
    /// Another program shows its picture there.
    #[error(
        "{0}: another program drives its displays (a desktop, a display manager, another run); switch to a bare console \
         (Ctrl+Alt+F3), or stop it: `systemctl isolate multi-user.target`; or start from within the desktop, which may lend \
         the display (projector.backend.lease)"
    )]
    InUse(String),
    /// The desktop does not lend the display.
    #[error("{lender} lends no display: {what}")]
    Unlent {
        /// Which desktop was asked.
        lender: String,
        /// Why, and what to do.
        what: String,
    },
    /// The driver cannot do it.
    #[error("{card}: {what}")]
    Unsuitable {
        /// Name of the card.
        card: String,
        /// What it cannot do, and what to do.
        what: String,
    },
    /// A call of the kernel failed.
    #[error("cannot {doing}: {source}")]
    Call {
        /// What was tried.
        doing: &'static str,
        /// The kernel's answer.
        source: io::Error,
    },
}

impl DisplayError {
    /// The same of the medium `device` of a link.
    pub fn of(self, device: String) -> TransportError {
        match self {
            Self::Gone | Self::Closed => TransportError::Unplugged { device },
            other => TransportError::Unsuitable { device, why: other.to_string() },
        }
    }
}

/// Shows pictures, each from a vertical blank on. It was started before, and showed black then.
pub trait ScanOut: Send {
    /// The memory of picture `frame`, 0 or 1.
    fn pixels(&mut self, frame: usize) -> Pixels<'_>;

    /// Has `picture` scanned out from the next vertical blank on; [`ScanOut::flips`] tells when it was taken. It does not
    /// wait for the blank.
    ///
    /// # Errors
    /// [`DisplayError::Busy`] while another has not been taken; or the display is gone.
    fn flip(&mut self, picture: PictureBuffer) -> Result<(), DisplayError>;

    /// Passes the pictures that were taken since the last call to `sink`. Never waits.
    fn flips(&mut self, sink: &mut dyn FnMut(Flip));

    /// Why nothing is shown any more, or `None`. Cheap enough for a few times a second.
    fn lost(&mut self) -> Option<DisplayError>;

    /// The clock of [`Flip::at_ns`], nanoseconds.
    fn now_ns(&self) -> i64;

    /// Shows black, waiting for the vertical blank where that is demanded (at most some frames). For every way out.
    fn blacken(&mut self);

    /// What a guardian process needs to show black when this program is dead: a descriptor for its standard output, and
    /// its arguments. `None` where there is nothing to guard.
    fn guarded(&self) -> Option<(OwnedFd, Vec<OsString>)>;
}

impl<S: ScanOut + ?Sized> ScanOut for Box<S> {
    fn pixels(&mut self, frame: usize) -> Pixels<'_> {
        (**self).pixels(frame)
    }
    fn flip(&mut self, picture: PictureBuffer) -> Result<(), DisplayError> {
        (**self).flip(picture)
    }
    fn flips(&mut self, sink: &mut dyn FnMut(Flip)) {
        (**self).flips(sink);
    }
    fn lost(&mut self) -> Option<DisplayError> {
        (**self).lost()
    }
    fn now_ns(&self) -> i64 {
        (**self).now_ns()
    }
    fn blacken(&mut self) {
        (**self).blacken();
    }
    fn guarded(&self) -> Option<(OwnedFd, Vec<OsString>)> {
        (**self).guarded()
    }
}
