//! Memory for the core, which takes all that it needs when the projector is made, and none afterwards.

use core::alloc::{GlobalAlloc, Layout};
use core::cell::UnsafeCell;
use core::ptr::null_mut;

/// Bytes. Seven frames of 24 planes of 384 bytes, and some more.
const ROOM: usize = 96 * 1024;

/// Gives memory and takes none back.
#[repr(align(8))]
struct Heap {
    room: UnsafeCell<[u8; ROOM]>,
    used: UnsafeCell<usize>,
}

// SAFETY: the only thread is the main loop, and no interrupt allocates.
unsafe impl Sync for Heap {}

#[global_allocator]
static HEAP: Heap = Heap { room: UnsafeCell::new([0; ROOM]), used: UnsafeCell::new(0) };

// SAFETY: every answer is a part of the room that no other answer overlaps, aligned as asked, or null.
unsafe impl GlobalAlloc for Heap {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: nothing else has a reference to the number; see `Sync`.
        let used = unsafe { &mut *self.used.get() };
        let room = self.room.get().cast::<u8>();
        let at = *used + room.wrapping_add(*used).align_offset(layout.align());
        match at.checked_add(layout.size()).filter(|end| *end <= ROOM) {
            Some(end) => {
                *used = end;
                room.wrapping_add(at)
            }
            // Without memory the program ends in `panic`, which is dark.
            None => null_mut(),
        }
    }

    unsafe fn dealloc(&self, _: *mut u8, _: Layout) {}
}
