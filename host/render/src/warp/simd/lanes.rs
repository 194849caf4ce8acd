//! Registers of eight or sixteen numbers, and what the warp does with them.
//!
//! A value of [`Avx2`] or [`Avx512`] is a proof that the CPU has these instructions, so what takes one is safe to call. All
//! methods are inlined into functions that are compiled for these instructions (`run_avx2` and `run_avx512` in the parent module).
#![allow(unsafe_code)]

use std::arch::x86_64::*;

/// The CPU has AVX2.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx2(());

/// The CPU has AVX-512 F and BW.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx512(());

impl Avx2 {
    pub(super) fn new() -> Option<Self> {
        is_x86_feature_detected!("avx2").then_some(Self(()))
    }
}

impl Avx512 {
    pub(super) fn new() -> Option<Self> {
        let has = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512bw");
        has.then_some(Self(()))
    }
}

/// Operations on registers of [`Lanes::N`] numbers of 32 bits. Names that end in 16 or 8 take the same register as numbers of 16 or
/// 8 bits; those that interleave, pack and shuffle do so within each 16 bytes.
pub(super) trait Lanes: Copy {
    /// Numbers in a register.
    const N: usize;
    /// A register.
    type V: Copy;
    /// A truth value for each number of a register.
    type M: Copy;

    fn splat(self, value: i32) -> Self::V;
    /// Four numbers of 16 bits, the first in the lowest bits, again and again.
    fn splat_four16(self, four: u64) -> Self::V;
    /// 0, 1, 2 and so on.
    fn numbers(self) -> Self::V;
    /// The first numbers of a slice, which must hold as many.
    fn load(self, from: &[u32]) -> Self::V;
    fn store(self, value: Self::V, to: &mut [u32]);
    fn and(self, a: Self::V, b: Self::V) -> Self::V;
    fn or(self, a: Self::V, b: Self::V) -> Self::V;
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// The low 32 bits of products.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    fn abs(self, a: Self::V) -> Self::V;
    /// Shifts to the left, to the right with zeros, and to the right with the sign.
    fn shl<const BY: u32>(self, a: Self::V) -> Self::V;
    fn shr<const BY: u32>(self, a: Self::V) -> Self::V;
    fn sar<const BY: u32>(self, a: Self::V) -> Self::V;
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    fn equal(self, a: Self::V, b: Self::V) -> Self::M;
    fn greater(self, a: Self::V, b: Self::V) -> Self::M;
    /// Whole quotients of positive numbers below 2^24, of which the divisor is at most 4096. The nearest float of such a quotient
    /// never reaches the next whole number: that is 2^-20 of it away at least.
    fn quotient(self, a: Self::V, b: Self::V) -> Self::V;

    fn both(self, a: Self::M, b: Self::M) -> Self::M;
    fn either(self, a: Self::M, b: Self::M) -> Self::M;
    /// True where `a` is and `b` is not.
    fn except(self, a: Self::M, b: Self::M) -> Self::M;
    /// Bit `i` is that of number `i`.
    fn bits(self, a: Self::M) -> u32;
    /// Numbers of `yes` where `m` is true, else those of `no`.
    fn choose(self, m: Self::M, yes: Self::V, no: Self::V) -> Self::V;
    /// Bits of `yes` where those of `mask` are 1, else those of `no`.
    fn merge(self, mask: Self::V, yes: Self::V, no: Self::V) -> Self::V;

    fn low8(self, a: Self::V, b: Self::V) -> Self::V;
    fn high8(self, a: Self::V, b: Self::V) -> Self::V;
    /// Sums of neighbouring products: those of the bytes of `a` without sign and those of `b` with sign.
    fn pairs8(self, a: Self::V, b: Self::V) -> Self::V;
    /// Sums of neighbouring products of 16 bits.
    fn pairs16(self, a: Self::V, b: Self::V) -> Self::V;
    fn add16(self, a: Self::V, b: Self::V) -> Self::V;
    fn sub16(self, a: Self::V, b: Self::V) -> Self::V;
    /// The upper halves of products of 16 bits.
    fn upper16(self, a: Self::V, b: Self::V) -> Self::V;
    fn shr16<const BY: u32>(self, a: Self::V) -> Self::V;
    /// 16 bits to 8, those of `a` into the lower half of each 16 bytes.
    fn pack16(self, a: Self::V, b: Self::V) -> Self::V;
    /// The low 16 bits of the first (`HALF` 0) or last (`HALF` 1) two numbers of each four, each four times.
    fn spread<const HALF: u8>(self, a: Self::V) -> Self::V;
}

/// Methods of two registers that are one instruction each.
macro_rules! instructions {
    ($($name:ident = $instruction:ident),+ $(,)?) => {$(
        #[inline(always)]
        fn $name(self, a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: `self` is the proof that the CPU has the instruction, which takes registers only.
            unsafe { $instruction(a, b) }
        }
    )+};
}

/// Methods that differ between the CPUs in the names of their instructions only.
macro_rules! registers {
    ($splat:ident, $splat_four16:ident, $load:ident, $store:ident, $abs:ident, $shuffle:ident,
     $truncated:ident, $divide:ident, $float:ident) => {
        #[inline(always)]
        fn splat(self, value: i32) -> Self::V {
            // SAFETY: `self` is the proof that the CPU has the instruction.
            unsafe { $splat(value) }
        }

        #[inline(always)]
        fn splat_four16(self, four: u64) -> Self::V {
            // SAFETY: `self` is the proof that the CPU has the instruction.
            unsafe { $splat_four16(four as i64) }
        }

        #[inline(always)]
        fn numbers(self) -> Self::V {
            self.load(&NUMBERS)
        }

        #[inline(always)]
        fn load(self, from: &[u32]) -> Self::V {
            let from = &from[..Self::N];
            // SAFETY: the slice has the numbers of a register, the load needs no alignment, and `self` is the proof that the CPU has
            // the instruction.
            unsafe { $load(from.as_ptr().cast()) }
        }

        #[inline(always)]
        fn store(self, value: Self::V, to: &mut [u32]) {
            let to = &mut to[..Self::N];
            // SAFETY: the slice has the numbers of a register, the store needs no alignment, and `self` is the proof that the CPU has
            // the instruction.
            unsafe { $store(to.as_mut_ptr().cast(), value) }
        }

        #[inline(always)]
        fn abs(self, a: Self::V) -> Self::V {
            // SAFETY: `self` is the proof that the CPU has the instruction, which takes registers only.
            unsafe { $abs(a) }
        }

        #[inline(always)]
        fn quotient(self, a: Self::V, b: Self::V) -> Self::V {
            // SAFETY: `self` is the proof that the CPU has the instructions, which take registers only.
            unsafe { $truncated($divide($float(a), $float(b))) }
        }

        #[inline(always)]
        fn spread<const HALF: u8>(self, a: Self::V) -> Self::V {
            // SAFETY: no register has more than the 64 bytes that are loaded from, the load needs no alignment, and `self` is the proof
            // that the CPU has the instructions.
            unsafe { $shuffle(a, $load(SPREAD[HALF as usize].as_ptr().cast())) }
        }
    };
}

/// Shifts by a constant.
macro_rules! shifts {
    ($($name:ident = $instruction:ident),+ $(,)?) => {$(
        #[inline(always)]
        fn $name<const BY: u32>(self, a: Self::V) -> Self::V {
            // SAFETY: `self` is the proof that the CPU has the instruction, which takes registers only.
            unsafe { $instruction(a, _mm_cvtsi32_si128(BY as i32)) }
        }
    )+};
}

/// For `spread`: bytes of the low halves of two numbers of each 16 bytes, each half four times.
const fn spread_bytes(half: u8) -> [u8; 64] {
    let mut out = [0; 64];
    let mut i = 0;
    while i < 64 {
        let number = 2 * half + (i as u8 % 16) / 8;
        out[i] = 4 * number + i as u8 % 2;
        i += 1;
    }
    out
}

static SPREAD: [[u8; 64]; 2] = [spread_bytes(0), spread_bytes(1)];
static NUMBERS: [u32; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

impl Lanes for Avx2 {
    const N: usize = 8;
    type V = __m256i;
    type M = __m256i;

    instructions! {
        and = _mm256_and_si256, or = _mm256_or_si256, add = _mm256_add_epi32, sub = _mm256_sub_epi32,
        mul = _mm256_mullo_epi32, min = _mm256_min_epi32, max = _mm256_max_epi32, equal = _mm256_cmpeq_epi32,
        greater = _mm256_cmpgt_epi32, both = _mm256_and_si256, either = _mm256_or_si256,
        low8 = _mm256_unpacklo_epi8, high8 = _mm256_unpackhi_epi8, pairs8 = _mm256_maddubs_epi16,
        pairs16 = _mm256_madd_epi16, add16 = _mm256_add_epi16, sub16 = _mm256_sub_epi16,
        upper16 = _mm256_mulhi_epi16, pack16 = _mm256_packus_epi16,
    }
    shifts! {
        shl = _mm256_sll_epi32, shr = _mm256_srl_epi32, sar = _mm256_sra_epi32,
        shr16 = _mm256_srl_epi16,
    }
    registers!(
        _mm256_set1_epi32,
        _mm256_set1_epi64x,
        _mm256_loadu_si256,
        _mm256_storeu_si256,
        _mm256_abs_epi32,
        _mm256_shuffle_epi8,
        _mm256_cvttps_epi32,
        _mm256_div_ps,
        _mm256_cvtepi32_ps
    );

    #[inline(always)]
    fn except(self, a: Self::M, b: Self::M) -> Self::M {
        // SAFETY: `self` is the proof that the CPU has AVX2.
        unsafe { _mm256_andnot_si256(b, a) }
    }

    #[inline(always)]
    fn bits(self, a: Self::M) -> u32 {
        // SAFETY: `self` is the proof that the CPU has AVX2.
        unsafe { _mm256_movemask_ps(_mm256_castsi256_ps(a)) as u32 }
    }

    #[inline(always)]
    fn choose(self, m: Self::M, yes: Self::V, no: Self::V) -> Self::V {
        // SAFETY: `self` is the proof that the CPU has AVX2.
        unsafe { _mm256_blendv_epi8(no, yes, m) }
    }

    #[inline(always)]
    fn merge(self, mask: Self::V, yes: Self::V, no: Self::V) -> Self::V {
        self.or(self.and(mask, yes), self.except(no, mask))
    }
}

impl Lanes for Avx512 {
    const N: usize = 16;
    type V = __m512i;
    type M = __mmask16;

    instructions! {
        and = _mm512_and_si512, or = _mm512_or_si512, add = _mm512_add_epi32, sub = _mm512_sub_epi32,
        mul = _mm512_mullo_epi32, min = _mm512_min_epi32, max = _mm512_max_epi32,
        low8 = _mm512_unpacklo_epi8, high8 = _mm512_unpackhi_epi8, pairs8 = _mm512_maddubs_epi16,
        pairs16 = _mm512_madd_epi16, add16 = _mm512_add_epi16, sub16 = _mm512_sub_epi16,
        upper16 = _mm512_mulhi_epi16, pack16 = _mm512_packus_epi16,
    }
    shifts! {
        shl = _mm512_sll_epi32, shr = _mm512_srl_epi32, sar = _mm512_sra_epi32,
        shr16 = _mm512_srl_epi16,
    }
    registers!(
        _mm512_set1_epi32,
        _mm512_set1_epi64,
        _mm512_loadu_si512,
        _mm512_storeu_si512,
        _mm512_abs_epi32,
        _mm512_shuffle_epi8,
        _mm512_cvttps_epi32,
        _mm512_div_ps,
        _mm512_cvtepi32_ps
    );

    #[inline(always)]
    fn equal(self, a: Self::V, b: Self::V) -> Self::M {
        // SAFETY: `self` is the proof that the CPU has AVX-512.
        unsafe { _mm512_cmpeq_epi32_mask(a, b) }
    }

    #[inline(always)]
    fn greater(self, a: Self::V, b: Self::V) -> Self::M {
        // SAFETY: `self` is the proof that the CPU has AVX-512.
        unsafe { _mm512_cmpgt_epi32_mask(a, b) }
    }

    #[inline(always)]
    fn both(self, a: Self::M, b: Self::M) -> Self::M {
        a & b
    }

    #[inline(always)]
    fn either(self, a: Self::M, b: Self::M) -> Self::M {
        a | b
    }

    #[inline(always)]
    fn except(self, a: Self::M, b: Self::M) -> Self::M {
        a & !b
    }

    #[inline(always)]
    fn bits(self, a: Self::M) -> u32 {
        u32::from(a)
    }

    #[inline(always)]
    fn choose(self, m: Self::M, yes: Self::V, no: Self::V) -> Self::V {
        // SAFETY: `self` is the proof that the CPU has AVX-512.
        unsafe { _mm512_mask_blend_epi32(m, no, yes) }
    }

    #[inline(always)]
    fn merge(self, mask: Self::V, yes: Self::V, no: Self::V) -> Self::V {
        // SAFETY: `self` is the proof that the CPU has AVX-512.
        unsafe { _mm512_ternarylogic_epi32::<0xca>(mask, yes, no) }
    }
}
