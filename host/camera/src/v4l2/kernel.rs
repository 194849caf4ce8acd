//! The calls of the kernel: requests to a device file, and the buffers that it shares with this process.
//!
//! All `unsafe` of this crate stands here. What is public is safe for any values: no struct with a pointer is taken from
//! outside, and a buffer can be read only while the driver has no part in it.
#![allow(unsafe_code)]

use super::abi::{
    Buffer, BufferRequest, Call, Capability, Control, ControlRange, Controls, Format, FormatEntry,
    FrameInterval, FrameSize, StreamParameters, CAPTURE, GET_CONTROLS, GIVE_BUFFER, MEMORY_MAPPED,
    PRESENT_VALUE, QUERY_BUFFER, REQUEST_BUFFERS, SET_CONTROLS, STREAM_OFF, STREAM_ON, TAKE_BUFFER,
};
use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::ptr::NonNull;
use std::time::Duration;

/// How often a request is made again that a signal has interrupted.
const MOST_INTERRUPTIONS: u32 = 16;
/// The largest buffer that is mapped: 8192 x 8192 pixels of two bytes.
const MOST_BYTES: u32 = 1 << 27;

/// A struct that the kernel fills or reads as it is, without following a pointer in it.
pub(super) trait Flat {}
impl Flat for Capability {}
impl Flat for FormatEntry {}
impl Flat for Format {}
impl Flat for StreamParameters {}
impl Flat for ControlRange {}
impl Flat for FrameSize {}
impl Flat for FrameInterval {}

/// An open device file.
pub(super) struct Node {
    file: File,
}

impl Node {
    /// Opens the device file at `path`; no call on it waits.
    ///
    /// # Errors
    /// Those of open(2).
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let file = File::options().read(true).write(true).custom_flags(libc::O_NONBLOCK).open(path)?;
        Ok(Self { file })
    }

    /// Makes a request, which may change `value`.
    ///
    /// # Errors
    /// Those of ioctl(2), which depend on the request.
    pub(super) fn call<T: Flat>(&self, call: &Call<T>, value: &mut T) -> io::Result<()> {
        self.request(call, value)
    }

    fn request<T>(&self, call: &Call<T>, value: &mut T) -> io::Result<()> {
        for _ in 0..MOST_INTERRUPTIONS {
            // SAFETY: the descriptor is open as long as `self`. The number of the request contains the size of `T`, so the
            // kernel reads and writes `value` and nothing beside it; whoever hands in a `T` with a pointer answers for what
            // it points to.
            let result =
                unsafe { libc::ioctl(self.file.as_raw_fd(), call.number, std::ptr::from_mut(value)) };
            if result >= 0 {
                return Ok(());
            }
            let error = io::Error::last_os_error();
            if error.kind() != io::ErrorKind::Interrupted {
                return Err(error);
            }
        }
        Err(io::ErrorKind::Interrupted.into())
    }

    /// The present value of a control.
    ///
    /// # Errors
    /// Those of VIDIOC_G_EXT_CTRLS: EINVAL if the device has no such control.
    pub(super) fn control(&self, id: u32) -> io::Result<i32> {
        self.exchange_control(&GET_CONTROLS, id, 0)
    }

    /// Sets a control. The value that the driver made of it.
    ///
    /// # Errors
    /// Those of VIDIOC_S_EXT_CTRLS: EINVAL if the device has no such control, ERANGE and EBUSY.
    pub(super) fn set_control(&self, id: u32, value: i32) -> io::Result<i32> {
        self.exchange_control(&SET_CONTROLS, id, value)
    }

    fn exchange_control(&self, call: &Call<Controls>, id: u32, value: i32) -> io::Result<i32> {
        let mut control = Control { id, value: [value, 0], ..Control::default() };
        // The list is one control of this function's frame, which outlives the request. Its size is 0: it has no payload.
        let list = &raw mut control;
        let mut all = Controls { which: PRESENT_VALUE, count: 1, failed: 0, request: 0, reserved: 0, list };
        self.request(call, &mut all)?;
        Ok(control.value[0])
    }

    /// Waits until a picture can be taken or the device has failed, at most for `limit`. False after a wait in vain.
    ///
    /// # Errors
    /// Those of poll(2).
    pub(super) fn wait(&self, limit: Duration) -> io::Result<bool> {
        let mut ready = Vec::with_capacity(1);
        let ms = limit.as_millis().clamp(1, 1000) as i32;
        dpm_common::unix::wait_readable(&[self.file.as_raw_fd()], ms, &mut ready)?;
        Ok(ready[0])
    }
}

/// Memory of the driver in this process.
struct Mapping {
    at: NonNull<libc::c_void>,
    bytes: usize,
    /// The driver has given the buffer and writes nothing into it.
    is_taken: bool,
}

// SAFETY: a mapping belongs to the process and not to a thread, and this value is its only owner.
unsafe impl Send for Mapping {}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mmap(2) gave this place and length, nobody else unmaps it, and no slice of it outlives `self`. The call
        // fails only for a place that is none.
        unsafe { libc::munmap(self.at.as_ptr(), self.bytes) };
    }
}

/// What the driver says of a buffer that it gave.
pub(super) struct Filling {
    /// The buffer.
    pub index: usize,
    /// Bytes that it holds.
    pub bytes: usize,
    /// `V4L2_BUF_FLAG_...`.
    pub flags: u32,
    /// When, by the clock that the flags name, ns.
    pub stamp_ns: i64,
    /// Number of the picture.
    pub sequence: u32,
}

/// A device that streams into buffers. Dropping it ends the stream.
pub(super) struct Stream {
    node: Node,
    buffers: Vec<Mapping>,
}

impl Stream {
    /// Begins to stream into `count` buffers, if the driver gives as many; it gives two at least.
    ///
    /// # Errors
    /// Those of the requests for buffers and of mmap(2). EBUSY: another program streams.
    pub(super) fn begin(node: Node, count: u32) -> io::Result<Self> {
        let mut request =
            BufferRequest { count, kind: CAPTURE, memory: MEMORY_MAPPED, ..BufferRequest::default() };
        node.request(&REQUEST_BUFFERS, &mut request)?;
        let mut stream = Self { node, buffers: Vec::new() };
        for index in 0..request.count.min(32) {
            let mut buffer = Buffer::mapped(index);
            stream.node.request(&QUERY_BUFFER, &mut buffer)?;
            stream.buffers.push(stream.map(&buffer)?);
        }
        if stream.buffers.len() < 2 {
            return Err(io::Error::new(io::ErrorKind::OutOfMemory, "the driver gives too few buffers"));
        }
        for index in 0..stream.buffers.len() {
            stream.give(index)?;
        }
        stream.node.request(&STREAM_ON, &mut (CAPTURE as i32))?;
        Ok(stream)
    }

    fn map(&self, buffer: &Buffer) -> io::Result<Mapping> {
        if !(1..=MOST_BYTES).contains(&buffer.length) {
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "the driver names a buffer without a size",
            ));
        }
        let bytes = buffer.length as usize;
        // SAFETY: a new mapping at a place that the kernel chooses: no memory of this process changes. The kernel checks
        // offset and length against the driver's buffer.
        let at = unsafe {
            libc::mmap(
                std::ptr::null_mut(),
                bytes,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_SHARED,
                self.node.file.as_raw_fd(),
                buffer.offset() as libc::off_t,
            )
        };
        if at == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        let at = NonNull::new(at).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Mapping { at, bytes, is_taken: true })
    }

    /// The device.
    pub(super) fn node(&self) -> &Node {
        &self.node
    }

    /// How many buffers there are.
    pub(super) fn buffers(&self) -> usize {
        self.buffers.len()
    }

    /// Gives a buffer to the driver.
    ///
    /// # Errors
    /// Those of VIDIOC_QBUF.
    pub(super) fn give(&mut self, index: usize) -> io::Result<()> {
        let buffer = self.buffers.get_mut(index).ok_or(io::ErrorKind::InvalidInput)?;
        buffer.is_taken = false;
        self.node.request(&GIVE_BUFFER, &mut Buffer::mapped(index as u32))
    }

    /// Takes the oldest buffer that is filled; `None` if there is none.
    ///
    /// # Errors
    /// Those of VIDIOC_DQBUF; a buffer that was never given.
    pub(super) fn take(&mut self) -> io::Result<Option<Filling>> {
        let mut buffer = Buffer::mapped(0);
        match self.node.request(&TAKE_BUFFER, &mut buffer) {
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            other => other?,
        }
        let index = buffer.index as usize;
        let mapping = self.buffers.get_mut(index).filter(|m| !m.is_taken);
        let mapping = mapping.ok_or_else(|| {
            io::Error::new(io::ErrorKind::InvalidData, "the driver gives a buffer that it does not have")
        })?;
        mapping.is_taken = true;
        let bytes = (buffer.bytes_used as usize).min(mapping.bytes);
        let (flags, stamp_ns, sequence) = (buffer.flags, buffer.stamp_ns(), buffer.sequence);
        Ok(Some(Filling { index, bytes, flags, stamp_ns, sequence }))
    }

    /// The bytes of a buffer that was taken; empty for one that the driver has.
    pub(super) fn bytes(&self, index: usize) -> &[u8] {
        let Some(mapping) = self.buffers.get(index).filter(|m| m.is_taken) else { return &[] };
        // SAFETY: the mapping is as long as said and lives as long as `self`. A driver does not write into a buffer between
        // giving and getting it back, and getting it back needs `&mut self`, which no slice outlives.
        unsafe { std::slice::from_raw_parts(mapping.at.as_ptr().cast(), mapping.bytes) }
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // A device that is gone has ended its stream. Closing the file, which follows, ends it in any case.
        let _ = self.node.request(&STREAM_OFF, &mut (CAPTURE as i32));
    }
}
