//! The kernel's writeback connector: what a CRTC composed for a blank, as pixels. It works on a duplicate of the descriptor
//! that drives the display, because the kernel takes commits from one opener at a time.

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::OwnedFd;
use std::time::{Duration, Instant};

use dpm_display::card::CardDescriptor;
use drm::buffer::{Buffer, DrmFourcc};
use drm::control::atomic::AtomicModeReq;
use drm::control::connector::Interface;
use drm::control::dumbbuffer::DumbBuffer;
use drm::control::{
    connector, crtc, framebuffer, property, AtomicCommitFlags, Device as ControlDevice, ResourceHandle,
};
use drm::{ClientCapability, Device, VblankWaitFlags, VblankWaitTarget};
use rustix::event::{poll, PollFd, PollFlags, Timespec};

use crate::rig::{CRC, PATIENCE};

/// A commit whose pixels have not come after this long waits for a composer that somebody switched off.
const COMPOSER_PATIENCE: Duration = Duration::from_millis(400);

/// Reads back what a CRTC composes.
pub(crate) struct WritebackReader {
    node: CardDescriptor,
    crtc: crtc::Handle,
    connector: connector::Handle,
    buffer: DumbBuffer,
    framebuffer: framebuffer::Handle,
    /// Of the connector: the picture to write to, and where the number of the fence goes.
    written: property::Handle,
    fence: property::Handle,
    active: property::Handle,
    /// What gives the CRTC back to the display's connector.
    back: AtomicModeReq,
}

impl WritebackReader {
    /// Puts the writeback connector at the CRTC numbered `crtc`, which `descriptor` drives with a mode of `size`, in the place
    /// of the display's: the kernel refuses a CRTC with both. The CRTC, its plane, its mode and its pictures stay, but it is
    /// restarted, so its blanks get another phase.
    pub(crate) fn attach(descriptor: OwnedFd, crtc: u32, size: (u32, u32)) -> Self {
        let node = CardDescriptor(descriptor);
        node.set_client_capability(ClientCapability::WritebackConnectors, true)
            .expect("a driver with writeback");
        let crtc = crtc::Handle::from(std::num::NonZeroU32::new(crtc).expect("a number"));
        let resources = node.resource_handles().unwrap();
        let is_writeback = |c: &connector::Handle| {
            node.get_connector(*c, false).is_ok_and(|info| info.interface() == Interface::Writeback)
        };
        let (writebacks, displays): (Vec<_>, Vec<_>) =
            resources.connectors().iter().copied().partition(is_writeback);
        let connector = *writebacks.first().expect("a writeback connector");
        let buffer = node.create_dumb_buffer(size, DrmFourcc::Xrgb8888, 32).unwrap();
        let framebuffer = node.add_framebuffer(&buffer, 24, 32).unwrap();
        let [written, fence] =
            ["WRITEBACK_FB_ID", "WRITEBACK_OUT_FENCE_PTR"].map(|name| property(&node, connector, name).0);
        let (active, _) = property(&node, crtc, "ACTIVE");
        let (mut request, mut back) = (AtomicModeReq::new(), AtomicModeReq::new());
        let number = u64::from(u32::from(crtc));
        for (connector, at) in displays.into_iter().map(|c| (c, 0)).chain([(connector, number)]) {
            let (attached, now) = property(&node, connector, "CRTC_ID");
            if now == number || at == number {
                request.add_raw_property(connector.into(), attached, at);
                back.add_raw_property(connector.into(), attached, number - at);
            }
        }
        let reader = Self { node, crtc, connector, buffer, framebuffer, written, fence, active, back };
        reader
            .commit(AtomicCommitFlags::ALLOW_MODESET, &request)
            .expect("the connector takes the display's place");
        reader
    }

    /// The count of the newest blank.
    pub(crate) fn blank(&self) -> u32 {
        self.node.wait_vblank(VblankWaitTarget::Relative(0), VblankWaitFlags::empty(), 0, 0).unwrap().frame()
    }

    /// Waits until `blanks` more have passed.
    pub(crate) fn wait_blanks(&self, blanks: u32) {
        self.node.wait_vblank(VblankWaitTarget::Relative(blanks), VblankWaitFlags::empty(), 0, 0).unwrap();
    }

    /// Has the kernel write one composed picture, and returns its pixels, rows without padding, as XRGB8888 with zeros in
    /// the unused bytes. It takes one blank or two, and waits for a picture that was handed over before.
    ///
    /// # Errors
    /// The kernel refuses the commit.
    ///
    /// # Panics
    /// The kernel does not write the whole picture.
    pub(crate) fn read(&mut self) -> io::Result<Vec<u8>> {
        // The kernel sets the unused byte of each pixel that it writes.
        self.node.map_dumb_buffer(&mut self.buffer)?.fill(0);
        let mut fence = -1i32;
        let mut request = AtomicModeReq::new();
        let framebuffer = u64::from(u32::from(self.framebuffer));
        request.add_raw_property(self.connector.into(), self.written, framebuffer);
        let place = &raw mut fence as usize as u64;
        request.add_raw_property(self.connector.into(), self.fence, place);
        self.commit(AtomicCommitFlags::empty(), &request)?;
        wait_for(&owned(fence));
        let (width, height) = self.buffer.size();
        let pitch = self.buffer.pitch() as usize;
        let map = self.node.map_dumb_buffer(&mut self.buffer)?;
        let rows = map.chunks(pitch).take(height as usize);
        let mut pixels: Vec<u8> = rows.flat_map(|row| &row[..4 * width as usize]).copied().collect();
        for (i, pixel) in pixels.chunks_exact_mut(4).enumerate() {
            assert_eq!(std::mem::take(&mut pixel[3]), 0xff, "pixel {i} was not written back");
        }
        Ok(pixels)
    }

    /// Keeps the CRTC busy until the next blank with a commit that changes nothing.
    pub(crate) fn occupy(&self) {
        let mut request = AtomicModeReq::new();
        request.add_raw_property(self.crtc.into(), self.active, 1);
        self.commit(AtomicCommitFlags::NONBLOCK, &request).expect("a commit that changes nothing");
    }

    fn commit(&self, flags: AtomicCommitFlags, request: &AtomicModeReq) -> io::Result<()> {
        let limit = Instant::now() + PATIENCE;
        loop {
            match self.node.atomic_commit(flags, request.clone()) {
                // A guardian has let go of the displays, for whoever takes them next.
                Err(e) if e.raw_os_error() == Some(libc::EACCES) && Instant::now() < limit => {
                    let _ = self.node.acquire_master_lock();
                }
                other => return other,
            }
        }
    }
}

impl Drop for WritebackReader {
    fn drop(&mut self) {
        // Refused where the CRTC is off by now: then nothing is attached to it either.
        let _ = self.commit(AtomicCommitFlags::ALLOW_MODESET, &self.back);
        let _ = self.node.destroy_framebuffer(self.framebuffer);
        let _ = self.node.destroy_dumb_buffer(self.buffer);
    }
}

/// A property of an object by its name, and its value.
fn property<T: ResourceHandle>(node: &CardDescriptor, object: T, name: &str) -> (property::Handle, u64) {
    let all = node.get_properties(object).unwrap();
    let (handles, values) = all.as_props_and_values();
    let is_it = |(handle, _): &(&property::Handle, &u64)| {
        node.get_property(**handle).is_ok_and(|info| info.name().to_bytes() == name.as_bytes())
    };
    let found = handles.iter().zip(values).find(is_it);
    found.map(|(handle, value)| (*handle, *value)).unwrap_or_else(|| panic!("no property {name}"))
}

/// The descriptor `fence`, which the kernel has just made for this process.
#[allow(unsafe_code, reason = "the kernel returns the descriptor as a number in memory")]
fn owned(fence: i32) -> OwnedFd {
    use std::os::fd::FromRawFd;
    assert!(fence >= 0, "a commit with writeback makes a fence");
    // SAFETY: the commit has succeeded, so that the number is an open descriptor that nobody else knows.
    unsafe { OwnedFd::from_raw_fd(fence) }
}

/// Waits until the kernel has written the picture of `fence`.
fn wait_for(fence: &OwnedFd) {
    let signalled = |patience: Duration| {
        let limit = Timespec { tv_sec: patience.as_secs() as i64, tv_nsec: patience.subsec_nanos().into() };
        let mut polled = [PollFd::new(fence, PollFlags::IN)];
        poll(&mut polled, Some(&limit)).is_ok_and(|ready| ready > 0)
    };
    if signalled(COMPOSER_PATIENCE) {
        return;
    }
    // vkms of Linux 6.1 composes while it is told to, and the end of the writeback before may have told it to stop after
    // this one had told it to go on. A reader of checksums has it go on.
    File::options().write(true).open(format!("{CRC}/control")).unwrap().write_all(b"auto").unwrap();
    let _composes = File::open(format!("{CRC}/data")).expect("the kernel's checksums");
    assert!(signalled(PATIENCE), "the kernel has not written the picture back");
}

/// The number of the CRTC that `descriptor`'s card drives with a mode of `size` now.
pub(crate) fn driven(descriptor: &OwnedFd, size: (u32, u32)) -> Option<u32> {
    let node = CardDescriptor(descriptor.try_clone().unwrap());
    let resources = node.resource_handles().unwrap();
    let is_it = |crtc: &&crtc::Handle| {
        let mode = node.get_crtc(**crtc).ok().and_then(|info| info.mode());
        mode.is_some_and(|mode| (u32::from(mode.size().0), u32::from(mode.size().1)) == size)
    };
    resources.crtcs().iter().find(is_it).map(|crtc| u32::from(*crtc))
}
