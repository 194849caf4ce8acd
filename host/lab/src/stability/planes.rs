//! Hard cases of quantising, bit planes and frame slots.

use super::CpuCase;
use crate::reference::Sampler;
use dpm_device::link::SlotClock;
use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec, Raster};
use dpm_device::time::{DeviceTicks, FrameRate};
use dpm_render::pack::{pack, quantise, unpack, BitPlaneFrame, Kernel};

/// The cases.
pub(super) const CASES: &[CpuCase] = &[
    CpuCase(
        "planes-all-code-values",
        "every value of every channel, all 24 planes",
        "unpack(pack(x)) = x",
        "pixels",
        0.0,
        all_codes,
    ),
    CpuCase(
        "planes-odd-rasters",
        "widths 1 to 67, 511, 513, 1023 and a row of 8192, every kernel",
        "bit for bit the plain loop; padding 0",
        "frames",
        0.0,
        odd_rasters,
    ),
    CpuCase(
        "planes-light-of-a-value",
        "sum of plane bits times LED weight 2^bit / 255",
        "code / 255",
        "light",
        1e-15,
        light_of_value,
    ),
    CpuCase(
        "quantiser-extremes",
        "NaN, -1, 2, infinities, denormals, +-0, the value just below 1",
        "0, 255 or the nearest; NaN black and counted",
        "faults",
        0.0,
        quantiser_extremes,
    ),
    CpuCase(
        "quantiser-rounding",
        "1,000,001 values of 0..1",
        "half a step",
        "LSB",
        0.5 + 2e-5,
        quantiser_rounding,
    ),
    CpuCase(
        "quantiser-dither-mean",
        "4096 even offsets, values across 0..1",
        "mean over frames = value",
        "LSB",
        2e-3,
        dither_mean,
    ),
    CpuCase(
        "slots-947-fps-for-400-days",
        "947 fps, 24,000/1001 fps, 1 fps: starts, lengths, inverse",
        "i128 rationals: within 1 ns without drift",
        "ns",
        1.0,
        slots,
    ),
    CpuCase(
        "slots-beyond-2-to-the-53",
        "slots 2^32, 2^53, 2^63, missed runs of up to 1e6",
        "i128: floor; no slot lost or doubled",
        "faults",
        0.0,
        far_slots,
    ),
    CpuCase(
        "slots-on-the-device-clock",
        "tick rates 1 kHz to 4 GHz, epoch near the wrap, slot 2^53",
        "i128: within a tick; slot_at inverts start",
        "ticks",
        1.0,
        device_slots,
    ),
];

fn raster(w: u32, h: u32) -> Raster {
    Raster::new(w, h).expect("sides within 1..8192")
}

fn all_codes(_: u64) -> f64 {
    let mut faults = 0usize;
    for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8()] {
        let codes: Vec<u32> =
            (0..3 * 256).map(|i| (i % 256) << (8 * (i / 256))).chain([0x00ff_ffff, 0x005a_a53c]).collect();
        let mut frame = BitPlaneFrame::new(raster(codes.len() as u32, 1), schedule);
        pack(Kernel::best(), &codes, &mut frame);
        let mut back = vec![0; codes.len()];
        unpack(&frame, &mut back);
        let shown = if schedule.len() == 24 { 0x00ff_ffff } else { 0x0000_ff00 };
        faults += codes.iter().zip(&back).filter(|(a, b)| **a & shown != **b).count();
    }
    faults as f64
}

fn odd_rasters(seed: u64) -> f64 {
    let mut s = Sampler::new(seed, 0);
    let mut faults = 0u32;
    let sizes =
        (1..=67).map(|w| (w, 3)).chain([(511, 2), (512, 2), (513, 5), (1023, 2), (8192, 1), (1, 100)]);
    for (w, h) in sizes {
        let codes: Vec<u32> = (0..w * h).map(|_| s.next_u64() as u32).collect();
        let r = raster(w, h);
        let schedule = PlaneSchedule::rgb24();
        // The definition, bit by bit.
        let mut want = vec![0u8; r.plane_bytes() * schedule.len()];
        for (p, spec) in schedule.planes().iter().enumerate() {
            let shift = 8 * spec.channel as u32 + u32::from(spec.bit);
            for (i, code) in codes.iter().enumerate() {
                let (x, y) = (i % w as usize, i / w as usize);
                let bit = (code >> shift & 1) as u8;
                want[p * r.plane_bytes() + y * r.row_bytes() + x / 8] |= bit << (7 - x % 8);
            }
        }
        for kernel in Kernel::available() {
            let mut frame = BitPlaneFrame::new(r, schedule);
            frame.bytes_mut().fill(0xff);
            pack(*kernel, &codes, &mut frame);
            faults += u32::from(frame.bytes() != want);
        }
    }
    f64::from(faults)
}

fn light_of_value(_: u64) -> f64 {
    let schedule = PlaneSchedule::rgb24();
    let mut worst: f64 = 0.0;
    for code in 0..256u32 {
        for (c, channel) in [Channel::Red, Channel::Green, Channel::Blue].into_iter().enumerate() {
            let mut frame = BitPlaneFrame::new(raster(1, 1), schedule);
            pack(Kernel::best(), &[code << (8 * c)], &mut frame);
            let lit = |(p, spec): (usize, &PlaneSpec)| {
                let on = frame.plane(p)[0] >> 7 == 1;
                if on && spec.channel == channel {
                    f64::from(1u32 << spec.bit) / 255.0
                } else {
                    0.0
                }
            };
            let light: f64 = schedule.planes().iter().enumerate().map(lit).sum();
            worst = worst.max((light - f64::from(code) / 255.0).abs());
        }
    }
    worst
}

fn quantiser_extremes(_: u64) -> f64 {
    let below_one = 1.0f32.next_down();
    let cases = [
        (f32::NAN, 0),
        (-f32::NAN, 0),
        (f32::INFINITY, 255),
        (f32::NEG_INFINITY, 0),
        (-1.0, 0),
        (2.0, 255),
        (0.0, 0),
        (-0.0, 0),
        (1e-45, 0),
        (f32::MIN_POSITIVE, 0),
        (1.0, 255),
        (below_one, 255),
        (128.0 / 255.0, 128),
        (f32::MAX, 255),
    ];
    let mut faults = 0u32;
    // Long enough for the vector path, once in each lane.
    for lane in 0..9 {
        for (value, want) in cases {
            let mut drive = [[0.25f32; 4]; 9];
            drive[lane] = [value, value, value, f32::NAN];
            let mut codes = [0u32; 9];
            let counts = quantise(&drive, None, &mut codes);
            faults += u32::from(codes[lane] != want * 0x0001_0101);
            faults += u32::from(counts.nan_pixels != u64::from(value.is_nan()));
            faults += u32::from(counts.clipped != if value > 1.0 { 3 } else { 0 });
            let others = codes.iter().enumerate().filter(|(i, c)| *i != lane && **c != 0x0040_4040).count();
            faults += others as u32;
        }
    }
    f64::from(faults)
}

fn quantiser_rounding(_: u64) -> f64 {
    let n = 1_000_000u32;
    let mut worst: f64 = 0.0;
    let mut codes = vec![0u32; 1000];
    for block in 0..=n / 1000 {
        let drive: Vec<[f32; 4]> =
            (0..1000u32).map(|i| [((block * 1000 + i).min(n) as f32) / n as f32; 4]).collect();
        quantise(&drive, None, &mut codes);
        for (d, code) in drive.iter().zip(&codes) {
            worst = worst.max((f64::from(code & 255) - 255.0 * f64::from(d[0])).abs());
        }
    }
    worst
}

fn dither_mean(_: u64) -> f64 {
    let frames = 4096u32;
    let offsets: Vec<f32> = (0..frames).map(|i| (i as f32 + 0.5) / frames as f32).collect();
    let mut codes = vec![0u32; frames as usize];
    let mut worst: f64 = 0.0;
    for i in 0..=200 {
        let value = i as f32 / 200.0;
        let drive = vec![[value; 4]; frames as usize];
        quantise(&drive, Some(&offsets), &mut codes);
        let mean = codes.iter().map(|c| f64::from(c & 255)).sum::<f64>() / f64::from(frames);
        worst = worst.max((mean - 255.0 * f64::from(value)).abs());
    }
    worst
}

fn rate(num: u32, den: u32) -> FrameRate {
    FrameRate::new(num, den).expect("neither is 0")
}

fn slots(_: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for (num, den) in [(947, 1), (24_000, 1001), (1, 1), (4225, 1)] {
        let r = rate(num, den);
        let last = 400 * 86_400 * u64::from(num) / u64::from(den);
        for i in 0..20_000u64 {
            let slot = last / 20_000 * i + i % 7;
            let start = r.slot_start_ns(slot);
            // |start * num - slot * 1e9 * den| / num in exact integers.
            let exact = i128::from(slot) * 1_000_000_000 * i128::from(den);
            let off = (i128::from(start) * i128::from(num) - exact).abs();
            worst = worst.max(off as f64 / f64::from(num));
            let shift = i128::from(r.slot_len_ns(slot)) * i128::from(num) - 1_000_000_000 * i128::from(den);
            worst = worst.max(shift.abs() as f64 / f64::from(num));
            if r.slot_at_ns(start) != slot || (slot > 0 && r.slot_at_ns(start - 1) != slot - 1) {
                return f64::INFINITY;
            }
        }
    }
    worst
}

fn far_slots(_: u64) -> f64 {
    let r = rate(947, 1);
    let mut faults = 0u32;
    for slot in [1u64 << 32, (1 << 32) - 1, 1 << 40, (1 << 33) + 1] {
        let exact = (u128::from(slot) * 1_000_000_000 / 947) as i64;
        faults += u32::from(r.slot_start_ns(slot) != exact);
        // A stage that slept through 1 to 1e6 slots resumes in the slot that is running, and counts what it missed.
        for missed in [1u64, 2, 947, 1_000_000] {
            let wake = r.slot_start_ns(slot + missed) + 17;
            faults += u32::from(r.slot_at_ns(wake) != slot + missed);
        }
    }
    // Beyond 292 years the answer saturates and stays ordered.
    for slot in [1u64 << 53, 1 << 63, u64::MAX] {
        faults += u32::from(
            r.slot_start_ns(slot) != (u128::from(slot) * 1_000_000_000 / 947).min(i64::MAX as u128) as i64,
        );
    }
    faults += u32::from(r.slot_at_ns(i64::MIN) != 0 || r.slot_at_ns(-1) != 0 || r.slot_at_ns(0) != 0);
    faults += u32::from(FrameRate::new(0, 1).is_some() || FrameRate::new(1, 0).is_some());
    f64::from(faults)
}

fn device_slots(_: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for hz in [1000u32, 1_000_000, 48_000_000, 4_000_000_000] {
        for (epoch, slot) in
            [(0u64, 0u64), (5, 1), (1 << 40, 947 * 86_400 * 365), (u64::MAX - (1 << 62), 1 << 31)]
        {
            let Some(clock) = SlotClock::new(DeviceTicks(epoch), hz, rate(947, 1)) else { return f64::NAN };
            let start = clock.start(slot);
            let exact = u128::from(slot) * u128::from(hz);
            let off = (u128::from(start.0 - epoch) * 947).abs_diff(exact);
            worst = worst.max(off as f64 / 947.0);
            if clock.slot_at(start) != Some(slot)
                || clock.slot_at(DeviceTicks(start.0.wrapping_sub(1))) == Some(slot)
            {
                return f64::INFINITY;
            }
        }
    }
    if SlotClock::new(DeviceTicks(0), 0, rate(947, 1)).is_some()
        || SlotClock::new(DeviceTicks(0), 900, rate(947, 1)).is_some()
    {
        return f64::INFINITY;
    }
    worst
}
