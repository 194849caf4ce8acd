//! Tracks against mirrors that are moved one by one, and against numbers worked out by hand.

use super::*;
use proptest::prelude::*;

const HZ: u32 = 10_000_000;

fn one(region: Region) -> Tracks {
    let mut tracks = Tracks::new(7, 1, DeviceTicks(1_000), 20_000);
    assert!(tracks.push(region));
    tracks
}

/// The shift of the only region `us` after its begin, in a slot that is `late_us` late, and whether it was clamped.
fn shift(region: Region, us: u64, late_us: u32) -> ([i8; 2], bool) {
    let instant = DeviceTicks(1_000 + us * 10);
    let moves = one(region).moves_at(instant, HZ, late_us, 16).expect("they hold");
    (moves.all()[0].shift, moves.was_clamped)
}

/// The numbers of section 14 of docs/PROTOCOL.md, worked out by hand.
#[test]
fn a_shift_is_the_rounded_distance_beyond_the_gate_and_within_the_clamp() {
    let area = Area { left: 0, top: 0, width: 8, height: 8 };
    let still = Region { area, clamp: 4, ..Region::default() };
    let at = |x: i16, y: i16| shift(Region { offset: [x, y], ..still }, 0, 0);
    assert_eq!(at(127, -127), ([0, 0], false), "less than half a mirror");
    assert_eq!(at(128, -128), ([1, -1], false), "half a mirror, away from 0");
    assert_eq!(at(383, -384), ([1, -2], false));
    assert_eq!(at(4 * 256 + 127, -4 * 256), ([4, -4], false));
    assert_eq!(at(4 * 256 + 128, 0), ([4, 0], true), "five mirrors, clamped to four");
    assert_eq!(at(i16::MAX, i16::MIN), ([4, -4], true));
    let gated = Region { gate: 200, ..still };
    assert_eq!(shift(Region { offset: [199, 200], ..gated }, 0, 0).0, [0, 1]);
    // After 1.5 ms: 256 * 1.5 = 384 to the right; -100 + floor(-64 * 2.25) = -244 upwards.
    let moving = Region { velocity: [256, 0], offset: [0, -100], half_acceleration: [0, -64], ..still };
    assert_eq!(shift(moving, 1500, 0), ([2, -1], false));
    // Two slots of 1056 us late: 300 * 2.112 = 633.6.
    assert_eq!(shift(Region { drawn: [300, 0], ..still }, 0, 2112), ([2, 0], false));
    // A device may shift by less than the host asks for.
    let moves = one(Region { offset: [768, 0], ..still }).moves_at(DeviceTicks(1_000), HZ, 0, 2).unwrap();
    assert_eq!((moves.all()[0].shift, moves.was_clamped), ([2, 0], true));
}

#[test]
fn tracks_hold_from_their_begin_on_for_as_long_as_they_say() {
    let tracks = Tracks::new(1, 1, DeviceTicks(5_000), 300);
    let holds = |ticks: u64| tracks.holds_at(DeviceTicks(ticks), HZ);
    assert!(!holds(4_999) && holds(5_000) && holds(8_009) && !holds(8_010), "300 us are 3000 ticks");
    assert!(!holds(u64::MAX) && !holds(0));
    assert!(Tracks::new(1, 1, DeviceTicks(0), 1).moves_at(DeviceTicks(u64::MAX), 1, u32::MAX, 64).is_none());
}

#[test]
fn only_so_many_regions_have_room() {
    let mut tracks = Tracks::new(1, 1, DeviceTicks(0), 1);
    assert!((0..MAX_REGIONS).all(|_| tracks.push(Region::default())));
    assert!(!tracks.push(Region::default()));
    assert_eq!(tracks.regions().len(), MAX_REGIONS);
    assert!(!tracks.fits(Raster::new(8, 8).unwrap()), "an empty rectangle fits no raster");
}

fn bit(raster: Raster, plane: &[u8], x: i64, y: i64) -> bool {
    plane[y as usize * raster.row_bytes() + x as usize / 8] << (x % 8) & 0x80 != 0
}

/// The region to which a mirror belongs.
fn owner(moves: &Moves, x: i64, y: i64) -> Option<usize> {
    moves.all().iter().position(|one| one.area.contains(x, y))
}

/// Mirror by mirror, as the specification says.
fn one_by_one(raster: Raster, plane: &[u8], moves: &Moves) -> Vec<u8> {
    let mut out = vec![0; plane.len()];
    for y in 0..i64::from(raster.height()) {
        for x in 0..i64::from(raster.width()) {
            let own = owner(moves, x, y);
            let [dx, dy] = moves.of_mirror(x, y).map(i64::from);
            let from = (x - dx, y - dy);
            let is_lit = match own {
                None => bit(raster, plane, x, y),
                Some(_) => owner(moves, from.0, from.1) == own && bit(raster, plane, from.0, from.1),
            };
            if is_lit {
                out[y as usize * raster.row_bytes() + x as usize / 8] |= 0x80 >> (x % 8);
            }
        }
    }
    out
}

fn lit(plane: &[u8]) -> u32 {
    plane.iter().map(|byte| byte.count_ones()).sum()
}

/// Rectangles on a raster of 45 x 20, and shifts.
fn any_moves() -> impl Strategy<Value = Moves> {
    let one = (0u16..45, 0u16..20, 1u16..46, 1u16..21, -20i8..21, -20i8..21);
    prop::collection::vec(one, 0..=MAX_REGIONS).prop_map(|all| {
        let mut moves = Moves::NONE;
        for (left, top, width, height, dx, dy) in all {
            let area = Area { left, top, width: width.min(45 - left), height: height.min(20 - top) };
            moves.all[usize::from(moves.len)] = Move { area, shift: [dx, dy] };
            moves.len += 1;
        }
        moves
    })
}

proptest! {
    /// Words are moved as single mirrors are. Nothing changes outside of the regions, no region gets more light than it
    /// had, and padding stays dark.
    #[test]
    fn planes_move_as_single_mirrors_do(moves in any_moves(), seed in any::<u64>()) {
        let raster = Raster::new(45, 20).unwrap();
        let mut state = seed | 1;
        let mut plane: Vec<u8> = (0..raster.plane_bytes()).map(|_| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 56) as u8
        }).collect();
        plane.chunks_mut(raster.row_bytes()).for_each(|row| row[5] &= 0b1111_1000);
        let mut out = vec![0xaa; plane.len()];
        move_plane(raster, &plane, &moves, &mut out);
        prop_assert_eq!(&out, &one_by_one(raster, &plane, &moves));
        prop_assert!(lit(&out) <= lit(&plane));
        for (y, x) in (0..20).flat_map(|y| (0..45).map(move |x| (y, x))) {
            if owner(&moves, x, y).is_none() {
                prop_assert_eq!(bit(raster, &out, x, y), bit(raster, &plane, x, y));
            }
        }
    }

    /// A picture that keeps the shift's distance from the edge of its region loses no mirror.
    #[test]
    fn a_picture_inside_its_region_is_conserved(dx in -6i8..7, dy in -6i8..7, seed in any::<u64>()) {
        let raster = Raster::new(64, 32).unwrap();
        let area = Area { left: 3, top: 2, width: 50, height: 28 };
        let mut moves = Moves::NONE;
        (moves.all[0], moves.len) = (Move { area, shift: [dx, dy] }, 1);
        let mut plane = vec![0u8; raster.plane_bytes()];
        for i in 0..200u64 {
            let at = (seed.wrapping_mul(i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize;
            let (x, y) = (9 + at % 38, 8 + at / 38 % 16);
            plane[y * raster.row_bytes() + x / 8] |= 0x80 >> (x % 8);
        }
        let mut out = vec![0; plane.len()];
        move_plane(raster, &plane, &moves, &mut out);
        prop_assert_eq!(lit(&out), lit(&plane));
        for (x, y) in (9..47i64).flat_map(|x| (8..24i64).map(move |y| (x, y))) {
            let to = (x + i64::from(dx), y + i64::from(dy));
            prop_assert_eq!(bit(raster, &plane, x, y), bit(raster, &out, to.0, to.1));
        }
    }

    /// Whatever a message says, no shift is beyond its clamp or the device's.
    #[test]
    fn no_shift_passes_the_clamp(bytes in prop::collection::vec(any::<u8>(), 24..=248), most in any::<u8>(),
                                 ticks in any::<u64>(), late_us in any::<u32>()) {
        let mut bytes = bytes;
        let regions = (bytes.len() - TRACKS_BYTES) / REGION_BYTES;
        bytes.truncate(TRACKS_BYTES + regions * REGION_BYTES);
        bytes[20] = regions as u8;
        bytes[16..20].copy_from_slice(&20_000u32.to_le_bytes());
        let tracks = Tracks::parse(&bytes).expect("a length and a time that are right");
        let instant = DeviceTicks(tracks.begin.0.saturating_add(ticks % 200_001));
        let Some(moves) = tracks.moves_at(instant, HZ, late_us, most) else { return Ok(()) };
        for (region, one) in tracks.regions().iter().zip(moves.all()) {
            let clamp = region.clamp.min(most).min(MAX_SHIFT);
            prop_assert!(one.shift.iter().all(|shift| shift.unsigned_abs() <= clamp));
        }
    }
}
