//! The buffers of a stream: memory that the program maps, a queue of those to fill, and one of those that are filled.

use std::collections::VecDeque;
use std::fs::File;
use std::io;
use std::os::fd::FromRawFd;
use std::os::unix::fs::FileExt;

/// What was filled in.
#[derive(Clone, Copy)]
pub(crate) struct Filling {
    pub index: usize,
    pub bytes: u32,
    pub flags: u32,
    pub stamp_ns: i64,
    pub sequence: u32,
}

/// A buffer: its memory, and whether the driver has it.
pub(crate) struct Buffer {
    pub memory: File,
    pub is_given: bool,
}

/// All buffers of a file.
#[derive(Default)]
pub(crate) struct Buffers {
    pub all: Vec<Buffer>,
    pub bytes: u32,
    pub empty: VecDeque<usize>,
    pub filled: VecDeque<Filling>,
}

/// By how much the offsets of two buffers differ: far more than a buffer has.
pub(crate) const APART: u32 = 1 << 28;

impl Buffers {
    pub(crate) fn make(count: usize, bytes: u32) -> io::Result<Self> {
        let all = (0..count).map(|_| Ok(Buffer { memory: memory(u64::from(bytes))?, is_given: false }));
        Ok(Self { all: all.collect::<io::Result<_>>()?, bytes, ..Self::default() })
    }

    /// Gives a buffer to the driver, which overwrites it at once: whoever still reads it sees that.
    pub(crate) fn give(&mut self, index: usize) -> Option<()> {
        let buffer = self.all.get_mut(index).filter(|b| !b.is_given)?;
        buffer.is_given = true;
        let noise: Vec<u8> = (0..self.bytes).map(|i| ((i * 151) >> 3) as u8).collect();
        buffer.memory.write_all_at(&noise, 0).ok()?;
        self.empty.push_back(index);
        Some(())
    }

    /// Fills the next buffer; false if the driver has none.
    pub(crate) fn fill(&mut self, bytes: &[u8], flags: u32, stamp_ns: i64, sequence: u32) -> bool {
        let Some(index) = self.empty.pop_front() else { return false };
        let room = bytes.len().min(self.bytes as usize);
        self.all[index].memory.write_all_at(&bytes[..room], 0).expect("memory of a buffer");
        self.filled.push_back(Filling { index, bytes: room as u32, flags, stamp_ns, sequence });
        true
    }
}

#[allow(unsafe_code)]
fn memory(bytes: u64) -> io::Result<File> {
    // SAFETY: a name and plain numbers.
    let fd = unsafe { libc::memfd_create(c"fake-v4l2".as_ptr(), libc::MFD_CLOEXEC) };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the call above has just made it, and nobody else has it.
    let file = unsafe { File::from_raw_fd(fd) };
    file.set_len(bytes)?;
    Ok(file)
}
