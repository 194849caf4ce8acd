//! Structs and requests of V4L2 on machines with 64 bits, by their numbers: written from the header, not from the program.

use std::ffi::c_void;

/// A request, by its number without the letter and the direction, and the bytes of its struct.
pub(crate) const QUERYCAP: (u32, u32) = (0, 104);
pub(crate) const ENUM_FMT: (u32, u32) = (2, 64);
pub(crate) const G_FMT: (u32, u32) = (4, 208);
pub(crate) const S_FMT: (u32, u32) = (5, 208);
pub(crate) const REQBUFS: (u32, u32) = (8, 20);
pub(crate) const QUERYBUF: (u32, u32) = (9, 88);
pub(crate) const QBUF: (u32, u32) = (15, 88);
pub(crate) const DQBUF: (u32, u32) = (17, 88);
pub(crate) const STREAMON: (u32, u32) = (18, 4);
pub(crate) const STREAMOFF: (u32, u32) = (19, 4);
pub(crate) const G_PARM: (u32, u32) = (21, 204);
pub(crate) const S_PARM: (u32, u32) = (22, 204);
pub(crate) const QUERYCTRL: (u32, u32) = (36, 68);
pub(crate) const TRY_FMT: (u32, u32) = (64, 208);
pub(crate) const G_EXT_CTRLS: (u32, u32) = (71, 32);
pub(crate) const S_EXT_CTRLS: (u32, u32) = (72, 32);
pub(crate) const ENUM_FRAMESIZES: (u32, u32) = (74, 44);
pub(crate) const ENUM_FRAMEINTERVALS: (u32, u32) = (75, 52);

/// The names of the requests, without `VIDIOC_`.
pub(crate) const NAMES: [(&str, (u32, u32)); 18] = [
    ("QUERYCAP", QUERYCAP),
    ("ENUM_FMT", ENUM_FMT),
    ("G_FMT", G_FMT),
    ("S_FMT", S_FMT),
    ("REQBUFS", REQBUFS),
    ("QUERYBUF", QUERYBUF),
    ("QBUF", QBUF),
    ("DQBUF", DQBUF),
    ("STREAMON", STREAMON),
    ("STREAMOFF", STREAMOFF),
    ("G_PARM", G_PARM),
    ("S_PARM", S_PARM),
    ("QUERYCTRL", QUERYCTRL),
    ("TRY_FMT", TRY_FMT),
    ("G_EXT_CTRLS", G_EXT_CTRLS),
    ("S_EXT_CTRLS", S_EXT_CTRLS),
    ("ENUM_FRAMESIZES", ENUM_FRAMESIZES),
    ("ENUM_FRAMEINTERVALS", ENUM_FRAMEINTERVALS),
];

/// Number and size of a request of V4L2; `None` for one of another letter.
pub(crate) fn request(number: u32) -> Option<(u32, u32)> {
    ((number >> 8) & 0xff == u32::from(b'V')).then_some((number & 0xff, (number >> 16) & 0x3fff))
}

/// The struct that a request carries.
pub(crate) struct Record {
    at: *mut u8,
    bytes: usize,
}

impl Record {
    /// The struct at `at`.
    ///
    /// # Safety
    /// It has `bytes` bytes, which nobody else touches while the value lives.
    #[allow(unsafe_code)]
    pub(crate) unsafe fn new(at: *mut c_void, bytes: usize) -> Self {
        Self { at: at.cast(), bytes }
    }

    /// The struct whose address lies at `offset`.
    ///
    /// # Safety
    /// There is one with `bytes` bytes.
    #[allow(unsafe_code)]
    pub(crate) unsafe fn behind(&self, offset: usize, bytes: usize) -> Self {
        let address = u64::from(self.get(offset)) | u64::from(self.get(offset + 4)) << 32;
        Self { at: address as *mut u8, bytes }
    }

    #[allow(unsafe_code)]
    pub(crate) fn get(&self, offset: usize) -> u32 {
        assert!(offset + 4 <= self.bytes);
        // SAFETY: within the struct, by the line above and the promise of `new`.
        u32::from_ne_bytes(unsafe { self.at.add(offset).cast::<[u8; 4]>().read_unaligned() })
    }

    #[allow(unsafe_code)]
    pub(crate) fn put(&mut self, offset: usize, value: u32) {
        assert!(offset + 4 <= self.bytes);
        // SAFETY: as above.
        unsafe { self.at.add(offset).cast::<[u8; 4]>().write_unaligned(value.to_ne_bytes()) };
    }

    pub(crate) fn put_long(&mut self, offset: usize, value: i64) {
        let bits = value as u64;
        self.put(offset, bits as u32);
        self.put(offset + 4, (bits >> 32) as u32);
    }

    #[allow(unsafe_code)]
    pub(crate) fn put_text(&mut self, offset: usize, room: usize, text: &str) {
        assert!(offset + room <= self.bytes);
        for i in 0..room {
            let byte = text.as_bytes().get(i).copied().filter(|_| i + 1 < room).unwrap_or(0);
            // SAFETY: as above.
            unsafe { self.at.add(offset + i).write(byte) };
        }
    }
}
