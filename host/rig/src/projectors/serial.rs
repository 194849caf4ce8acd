//! `projector.backend.kind = "serial"`: a bit-plane projector on a serial port.

use super::compaction::Compaction;
use super::keys::{Cable, DeviceName, Medium, Opening, Panel, ProjectorKeys};
use super::kind::ProjectorKind;
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::section;
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::TransportError;

section! {
    /// A bit-plane projector on a serial port: small rasters and tests.
    pub struct SerialProjectorConfig {
        /// Device file of the port.
        port: String = "/dev/ttyUSB0".into(), "", NotEmpty;
        /// Bits per second on the wire.
        baud: u32 = 921_600, "bit/s", Within(300, 20_000_000);
        /// How planes are compacted, as for kind = "usb".
        compaction: Compaction = Compaction::Auto, "", Any;
    }
}

pub(super) static KIND: ProjectorKind = ProjectorKind::of::<SerialProjectorConfig>(
    "serial",
    "projector on",
    "a bit-plane projector on a serial port.",
    "docs/PROTOCOL.md",
);

impl SerialProjectorConfig {
    fn settings(&self, panel: &Panel) -> SerialSettings {
        SerialSettings { path: self.port.clone(), baud: self.baud, frame_bytes: panel.frame_bytes() }
    }
}

impl ProjectorKeys for SerialProjectorConfig {
    fn device(&self) -> DeviceName {
        DeviceName { named: Some(self.port.clone()), ..DeviceName::of(KIND.name) }
    }

    fn port(&self) -> Option<&str> {
        Some(&self.port)
    }

    fn compaction(&self) -> Option<Compaction> {
        Some(self.compaction)
    }

    fn cable(&self) -> Cable {
        // Ten bits a byte.
        Cable::Serial { bytes_per_s: self.baud / 10 }
    }

    fn look(&self, panel: &Panel) -> Result<(), TransportError> {
        self.settings(panel).look()
    }

    fn open(&self, opening: &Opening<'_>) -> Result<Option<Medium>, TransportError> {
        let is_another = opening.is_another.clone();
        let transport = SerialTransport::open_unless(self.settings(opening.panel), move || is_another())?;
        Ok(Some(Medium { transport: Box::new(transport), warnings: Vec::new() }))
    }
}
