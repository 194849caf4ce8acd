//! Cameras made of software behind the calls by which a program uses `/dev/videoN`. For tests only.
//!
//! The crate defines `open`, `ioctl`, `mmap`, `close` and their relatives; linked into a test binary (or preloaded), they stand
//! before those of the C library. What does not concern a fake camera goes straight to the kernel. A camera lies at any path
//! that a test names. Its pictures come from a mock camera on a socket ([`dpm_device::picture_stream`], `hil-mock serve
//! camera`), so bodies, noise, rolling shutter and lost pictures are the mock's; the fake turns them into the camera's format,
//! numbers and stamps them, and hands them out in buffers of its own.
//!
//! Structs and numbers are written here once more, by their offsets: a mistake in the program's own cannot cancel out.
//!
//! Where V4L2 leaves open what happens, the fake does the worse: a buffer that the driver has is overwritten, rows are padded,
//! what was asked is changed to what there is, and a request that breaks a rule of the documentation is refused.
//!
//! In a test: `FakeCamera::plug_in("path=/tmp/x/video0 from=127.0.0.1:8951 size=640x400")`. As a preloaded library the variable
//! `FAKE_V4L2` names a file with a camera on each line, which is read again all the time: a line that is gone is a camera that
//! was unplugged. [`Settings::parse`] has the words of a line.

mod buffers;
mod device;
mod hooks;
mod layout;
mod pictures;
mod settings;
mod world;

pub use settings::{Settings, Stamp};
pub use world::{FakeCamera, Witness};
