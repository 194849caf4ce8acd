//! `projector.backend.kind = "usb"`: a bit-plane projector on USB.

use super::compaction::Compaction;
use super::keys::{Cable, DeviceName, Medium, Opening, Panel, ProjectorKeys};
use super::kind::ProjectorKind;
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::section;
use dpm_device::transport::usb::{UsbSettings, UsbTransport, PRODUCT_ID, VENDOR_ID};
use dpm_device::transport::TransportError;

section! {
    /// A bit-plane projector on USB.
    pub struct UsbProjectorConfig {
        /// USB vendor id.
        vendor_id: u16 = VENDOR_ID, "", Any;
        /// USB product id.
        product_id: u16 = PRODUCT_ID, "", Any;
        /// Serial number of the device; needed if several are plugged in.
        serial_number: Option<String> = None, "", NotEmpty;
        /// Frames queued at once. More frames bridge longer pauses of the host, and each adds a frame of latency to a
        /// full link. They must fit into the kernel's `usbfs_memory_mb`.
        transfers_in_flight: u32 = 2, "frames", Within(1, 64);
        /// How planes are compacted. "auto" chooses for each plane the smallest of raw, RLE, XOR with the previous
        /// frame + RLE, and LZ4, and does not send unchanged planes. A list permits only those codecs. "raw" saves the
        /// host's time.
        compaction: Compaction = Compaction::Auto, "", Any;
    }
}

pub(super) static KIND: ProjectorKind = ProjectorKind::of::<UsbProjectorConfig>(
    "usb",
    "USB projector",
    "a bit-plane projector on USB.",
    "docs/PROTOCOL.md",
)
.by_usb(VENDOR_ID, PRODUCT_ID, "bit-plane projector");

impl UsbProjectorConfig {
    fn settings(&self, panel: &Panel) -> UsbSettings {
        UsbSettings {
            vendor_id: self.vendor_id,
            product_id: self.product_id,
            serial: self.serial_number.clone(),
            depth: self.transfers_in_flight as usize,
            ..UsbSettings::new(panel.frame_bytes())
        }
    }
}

impl ProjectorKeys for UsbProjectorConfig {
    fn device(&self) -> DeviceName {
        let family = format!("{} {:04x}:{:04x}", KIND.name, self.vendor_id, self.product_id);
        DeviceName { named: self.serial_number.clone(), is_proof: true, ..DeviceName::of(family) }
    }

    fn compaction(&self) -> Option<Compaction> {
        Some(self.compaction)
    }

    fn cable(&self) -> Cable {
        Cable::Usb
    }

    fn carries_tracks(&self) -> bool {
        true
    }

    fn look(&self, panel: &Panel) -> Result<(), TransportError> {
        self.settings(panel).look()
    }

    fn open(&self, opening: &Opening<'_>) -> Result<Option<Medium>, TransportError> {
        let settings = self.settings(opening.panel);
        let warnings = settings.memory_advice().into_iter().collect();
        Ok(Some(Medium { transport: Box::new(UsbTransport::open(settings)?), warnings }))
    }
}
