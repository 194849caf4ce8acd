//! What this crate needs of the kernel's mode setting, as a trait: the real one is [`crate::card::Card`], the one of tests
//! [`crate::fake::FakeKms`].

use crate::mode::Timing;
use crate::scan_out::{DisplayError, ScanOut};

/// Which object a property belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PropertyOwner {
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
    pub owner: PropertyOwner,
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
pub struct ScanOutSetup {
    /// The connector's name.
    pub connector: String,
    /// The mode.
    pub timing: Timing,
    /// Properties with their values.
    pub properties: Vec<(PropertyOwner, String, u64)>,
}

/// Mode setting: what shows pictures once it is started.
pub trait Kms: ScanOut {
    /// Name of the card.
    fn name(&self) -> String;

    /// All connectors, with what is there now. It may take long.
    ///
    /// # Errors
    /// The card is gone or refuses.
    fn connectors(&mut self) -> Result<Vec<Connector>, DisplayError>;

    /// Takes the connector, sets mode and properties in one step, and shows black. What was started before ends. It may
    /// take long.
    ///
    /// # Errors
    /// The kernel refuses; then nothing has changed.
    fn start(&mut self, setup: &ScanOutSetup) -> Result<(), DisplayError>;

    /// Who has lent the display, if it is lent.
    fn lender(&self) -> Option<&str> {
        None
    }
}
