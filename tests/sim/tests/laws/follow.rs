//! Two readings of section 14 of docs/PROTOCOL.md are one: the simulator's and the firmware's, for regions that overlap, too,
//! which no life of the simulator has.

use dpm_device::link::{move_plane, Area, Moves, Region, Tracks};
use dpm_device::planes::Raster;
use dpm_device::time::DeviceTicks;
use dpm_sim::dice::Dice;
use dpm_sim::follow::{expected, moved, Shift};

const TICK_HZ: u32 = 1_000_000_000;

fn region(dice: &mut Dice, raster: Raster) -> Region {
    let mut side = |most: u32| {
        let first = dice.between(0, i64::from(most) - 1);
        (first as u16, dice.between(1, i64::from(most) - first) as u16)
    };
    let ((left, width), (top, height)) = (side(raster.width()), side(raster.height()));
    let mut pair = |most: i64| [0, 1].map(|_| dice.between(-most, most) as i16);
    let (offset, velocity) = (pair(3_000), pair(300));
    let (half_acceleration, drawn) = (pair(40), pair(300));
    let area = Area { left, top, width, height };
    let (clamp, gate) = (dice.between(0, 20) as u8, dice.between(0, 600) as u16);
    Region { area, clamp, gate, offset, velocity, half_acceleration, drawn }
}

#[test]
fn the_simulator_and_the_firmware_read_tracks_alike() {
    let raster = Raster::new(64, 48).unwrap_or_else(|| panic!("a raster"));
    let mut dice = Dice::new(14, 0);
    let [mut shifted, mut stale] = [0; 2];
    for round in 0..3_000 {
        let lasts = dice.between(1, 6_000) as u32;
        let mut tracks = Tracks::new(7, 1, DeviceTicks(5_000_000), lasts);
        for _ in 0..round % 9 {
            tracks.push(region(&mut dice, raster));
        }
        let middle = 5_000_000 + dice.between(-500_000, 6_000_000);
        let (late_us, most) = (dice.between(0, 9_000) as u32, dice.between(0, 20) as u8);
        let mine = expected(Some(&tracks), middle as u64, i128::from(late_us), TICK_HZ, most);
        let told = tracks.moves_at(DeviceTicks(middle as u64), TICK_HZ, late_us, most);
        let moves = told.unwrap_or(Moves::NONE);
        let theirs: Vec<_> = moves.all().iter().map(|one| Shift { area: one.area, by: one.shift }).collect();
        assert_eq!((mine.is_stale, &mine.shifts), (told.is_none(), &theirs), "{tracks:?} at {middle}");
        assert_eq!(mine.was_clamped, moves.was_clamped, "{tracks:?} at {middle}");
        let plane: Vec<u8> = (0..raster.plane_bytes()).map(|_| dice.bits() as u8).collect();
        let mut light = vec![0; plane.len()];
        move_plane(raster, &plane, &moves, &mut light);
        assert!(moved(raster, &plane, &light, &mine.shifts), "{:?}", mine.shifts);
        // A single mirror that is wrong shows.
        light[dice.bits() as usize % plane.len()] ^= 1 << (dice.bits() % 8);
        assert!(!moved(raster, &plane, &light, &mine.shifts));
        shifted += u32::from(mine.is_moved());
        stale += u32::from(mine.is_stale);
    }
    assert!(shifted > 1_000 && stale > 500, "{shifted} moved, {stale} stale");
}
