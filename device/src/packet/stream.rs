//! A copy past the caches, for bytes that another core or the medium takes next.
//!
//! A usual store first fetches the line that it writes to, from the core that has read the frame before from the same
//! memory. The copy then waits for memory most of the time, and puts what this core does not need again in place of
//! what the stages share.
#![allow(unsafe_code)]

use core::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_sfence, _mm_stream_si128};

/// Copies `from` to the beginning of `to`. What is stored is visible to another thread by whatever passes `to` on.
///
/// # Panics
/// When `to` is shorter.
pub(super) fn copy(to: &mut [u8], from: &[u8]) {
    let to = &mut to[..from.len()];
    // A head and a tail, so that every register between them goes to a whole aligned place.
    let head = to.as_ptr().align_offset(size_of::<__m128i>()).min(to.len());
    let (to_head, to_rest) = to.split_at_mut(head);
    let (from_head, from_rest) = from.split_at(head);
    to_head.copy_from_slice(from_head);
    let (to_registers, to_tail) = to_rest.as_chunks_mut::<16>();
    let (from_registers, from_tail) = from_rest.as_chunks::<16>();
    for (to, from) in to_registers.iter_mut().zip(from_registers) {
        // SAFETY: 16 bytes each, the target aligned by the head before it; the load needs no alignment. SSE2 is part of
        // every x86-64.
        unsafe { _mm_stream_si128(to.as_mut_ptr().cast(), _mm_loadu_si128(from.as_ptr().cast())) };
    }
    to_tail.copy_from_slice(from_tail);
    // SAFETY: SSE is part of every x86-64. Stores past the caches are not ordered by the hand-off that follows.
    unsafe { _mm_sfence() };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_and_no_other_is_copied_wherever_it_lies() {
        let source: Vec<u8> = (0..200).map(|i| i as u8 ^ 0x5a).collect();
        for (at, from, len) in
            (0..20).flat_map(|at| [(at, 0, 0), (at, 3, 1), (at, 1, 15), (at, 7, 100), (at, 16, 64)])
        {
            let mut out = [0xee_u8; 200];
            copy(&mut out[at..], &source[from..from + len]);
            assert!(out[..at].iter().chain(&out[at + len..]).all(|b| *b == 0xee), "{at} {from} {len}");
            assert_eq!(out[at..at + len], source[from..from + len]);
        }
    }
}
