//! What this crate needs of the kernel's mode setting, as a trait: the real one is [`crate::card::Card`], the one of tests
//! [`crate::fake::FakeKms`].

use std::ffi::OsString;
use std::io;
use std::os::fd::OwnedFd;

use crate::mode::Timing;

/// Which object a property belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The connector.
    Connector,
    /// What scans out.
    Crtc,
    /// The primary plane.
    Plane,
}

/// Values that a property takes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Domain {
    /// From the first to the second.
    Range(u64, u64),
    /// Named values.
    Words(Vec<(String, u64)>),
    /// The number of a blob; 0 is none.
    Blob,
    /// Anything else.
    Other,
}

/// A property of a connector or of what drives it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Property {
    /// Whose it is.
    pub owner: Owner,
    /// The kernel's name.
    pub name: String,
    /// What it takes.
    pub domain: Domain,
    /// False if it can only be read.
    pub is_mutable: bool,
    /// What it is now.
    pub value: u64,
}

/// A place for a cable, and what is at its end.
#[derive(Clone, Debug)]
pub struct Connector {
    /// Its name, as `/sys/class/drm` has it behind the card: "HDMI-A-1".
    pub name: String,
    /// There is no cable: the kernel's own virtual display.
    pub is_virtual: bool,
    /// A display is there.
    pub is_connected: bool,
    /// What the display offers, the preferred one first.
    pub modes: Vec<Timing>,
    /// Of the connector, and of the CRTC and plane that would drive it.
    pub properties: Vec<Property>,
}

/// What is set when scan-out starts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Setup {
    /// The connector's name.
    pub connector: String,
    /// The mode.
    pub timing: Timing,
    /// Properties with their values.
    pub properties: Vec<(Owner, String, u64)>,
}

/// One of the three pictures in the display's memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Picture {
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
    /// The kernel's count of vertical blanks. It wraps.
    pub sequence: u32,
    /// When the first pixel of the picture was sent, on the clock of [`Kms::now_ns`].
    pub at_ns: i64,
}

/// Why the kernel does not do what it is asked.
#[derive(Debug, thiserror::Error)]
pub enum KmsError {
    /// The display or its card is gone.
    #[error("the display is unplugged or switched off")]
    Gone,
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
         (Ctrl+Alt+F3), or stop it: `systemctl isolate multi-user.target`"
    )]
    InUse(String),
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

/// Mode setting. Only [`Kms::start`] and [`Kms::connectors`] may take long.
pub trait Kms: Send {
    /// Name of the card.
    fn name(&self) -> String;

    /// All connectors, with what is there now.
    ///
    /// # Errors
    /// The card is gone or refuses.
    fn connectors(&mut self) -> Result<Vec<Connector>, KmsError>;

    /// Takes the connector, sets mode and properties in one step, and shows black. What was started before ends.
    ///
    /// # Errors
    /// The kernel refuses; then nothing has changed.
    fn start(&mut self, setup: &Setup) -> Result<(), KmsError>;

    /// The memory of picture `frame`, 0 or 1. Not to be called before [`Kms::start`].
    fn pixels(&mut self, frame: usize) -> Pixels<'_>;

    /// Has `picture` scanned out from the next vertical blank on; [`Kms::flips`] tells when it was taken. Never waits,
    /// allocates nothing.
    ///
    /// # Errors
    /// [`KmsError::Busy`] while another has not been taken; or the display is gone.
    fn flip(&mut self, picture: Picture) -> Result<(), KmsError>;

    /// Passes the pictures that were taken since the last call to `sink`. Never waits, allocates nothing.
    fn flips(&mut self, sink: &mut dyn FnMut(Flip));

    /// Whether a display is at the connector. Cheap enough for a few times a second.
    fn is_connected(&mut self) -> bool;

    /// The clock of [`Flip::at_ns`], nanoseconds.
    fn now_ns(&self) -> i64;

    /// Shows black, waiting for the vertical blank where the kernel demands it (at most some frames). For every way out.
    fn blacken(&mut self);

    /// What a guardian process needs to show black when this program is dead: a descriptor for its standard output, and
    /// its arguments. `None` where there is nothing to guard.
    fn guarded(&self) -> Option<(OwnedFd, Vec<OsString>)>;
}

impl<K: Kms + ?Sized> Kms for Box<K> {
    fn name(&self) -> String {
        (**self).name()
    }
    fn connectors(&mut self) -> Result<Vec<Connector>, KmsError> {
        (**self).connectors()
    }
    fn start(&mut self, setup: &Setup) -> Result<(), KmsError> {
        (**self).start(setup)
    }
    fn pixels(&mut self, frame: usize) -> Pixels<'_> {
        (**self).pixels(frame)
    }
    fn flip(&mut self, picture: Picture) -> Result<(), KmsError> {
        (**self).flip(picture)
    }
    fn flips(&mut self, sink: &mut dyn FnMut(Flip)) {
        (**self).flips(sink);
    }
    fn is_connected(&mut self) -> bool {
        (**self).is_connected()
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
