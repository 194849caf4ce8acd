//! The video input: patterns are cut out of the frame that has arrived while the next one arrives.

use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_dlpc900::command::Opcode;
use dpm_dlpc900::lut::{DisplayMode, LutEntry};

use super::controller::{Controller, Sequencer};

/// Hardware status: the sequence was aborted.
pub(super) const ABORTED: u8 = 0x40;

/// What the video input has received.
#[derive(Debug, Default)]
pub(super) struct VideoInput {
    /// Columns and rows of the frame.
    size: [usize; 2],
    /// Its pixels, XRGB8888, row by row.
    pixels: Vec<u8>,
    /// When the newest frame had arrived, which is when its patterns begin; `None` before the first.
    sync_at: Option<HostTime>,
    /// The patterns of the frame before it had not ended: nothing is shown until the next frame.
    is_aborted: bool,
}

/// The part of the input that is shown, and where: first column and row of the input, columns and rows, first column and
/// row of the mirrors.
struct Crop {
    from: [usize; 2],
    size: [usize; 2],
    to: [usize; 2],
}

impl Crop {
    /// From the 16 bytes of the input display resolution. Zeros are the setting of a controller that was just switched
    /// on: the whole input.
    fn of(setting: &[u8], input: [usize; 2]) -> Self {
        let number = |i: usize| {
            let bytes = setting.get(2 * i..2 * i + 2).map_or([0, 0], |b| [b[0], b[1]]);
            usize::from(u16::from_le_bytes(bytes))
        };
        let whole = |n: usize, all: usize| if n == 0 { all } else { n };
        Self {
            from: [number(0), number(1)],
            size: [whole(number(2), input[0]), whole(number(3), input[1])],
            to: [number(4), number(5)],
        }
    }

    /// The place in the input that mirror `at` along `axis` shows.
    fn source(&self, axis: usize, at: usize, input: usize) -> Option<usize> {
        let within = at.checked_sub(self.to[axis]).filter(|i| *i < self.size[axis])?;
        Some(within + self.from[axis]).filter(|i| *i < input)
    }
}

impl VideoInput {
    /// Bit plane `plane` (0 to 23) of the frame on the mirrors of `raster`.
    fn plane(&self, plane: usize, raster: Raster, crop: &Crop) -> Vec<u8> {
        let mut out = vec![0; raster.plane_bytes()];
        // In memory blue, green, red; in time green, red, blue.
        let (byte, bit) = ([1, 2, 0][plane / 8 % 3], plane % 8);
        for (y, row) in out.chunks_mut(raster.row_bytes()).enumerate() {
            let Some(from) = crop.source(1, y, self.size[1]) else { continue };
            let pixels = &self.pixels[4 * from * self.size[0]..][..4 * self.size[0]];
            for x in 0..raster.width() as usize {
                let lit =
                    crop.source(0, x, self.size[0]).is_some_and(|x| pixels[4 * x + byte] >> bit & 1 != 0);
                row[x / 8] |= u8::from(lit) << (7 - x % 8);
            }
        }
        out
    }
}

impl Controller {
    /// A frame of `size` (columns, rows) has arrived: its last row is there, and the next frame begins. `pixels` are
    /// XRGB8888, row by row; none of them for black.
    pub(super) fn video_frame(&mut self, now: HostTime, size: [u32; 2], pixels: &[u8]) {
        let ran_us = if self.has_video() { self.video_elapsed_us(now) } else { None };
        self.video.is_aborted = ran_us.is_some_and(|us| us < self.patterns.table_us());
        if self.video.is_aborted {
            self.hardware_fault |= ABORTED;
        }
        let [width, height] = size.map(|n| n as usize);
        self.video.size = [width, height];
        self.video.pixels.clear();
        self.video.pixels.extend_from_slice(&pixels[..pixels.len().min(4 * width * height)]);
        self.video.pixels.resize(4 * width * height, 0);
        self.video.sync_at = Some(now);
    }

    /// True once a frame has arrived: the patterns of video are those of the input.
    pub(super) fn has_video(&self) -> bool {
        self.video.sync_at.is_some() && self.mode == DisplayMode::VideoPattern
    }

    /// Time since the patterns of the newest frame began; `None` if none of them are shown, because the sequence was
    /// started after that or was aborted.
    pub(super) fn video_elapsed_us(&self, now: HostTime) -> Option<u64> {
        let sync_at = self.video.sync_at.filter(|_| !self.video.is_aborted)?;
        match self.sequencer {
            Sequencer::Running(since, _) if since <= sync_at => {
                Some((now.ns_since(sync_at).max(0) / 1000) as u64)
            }
            _ => None,
        }
    }

    /// Bit `bit` of pattern `entry` of the newest frame.
    pub(super) fn video_plane(&self, entry: &LutEntry, bit: u8) -> Option<Vec<u8>> {
        if bit >= entry.depth || !self.has_video() {
            return None;
        }
        let crop = Crop::of(&self.setting(Opcode::DISPLAY_RESOLUTION), self.video.size);
        Some(self.video.plane(usize::from(entry.bit + bit), self.options.dmd.raster(), &crop))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Dlpc900Fault, Dlpc900Model, VirtualHid};
    use super::*;
    use dpm_device::planes::PlaneSchedule;
    use dpm_device::time::FrameRate;
    use dpm_dlpc900::driver::Dlpc900;
    use dpm_dlpc900::lut::Dmd;
    use dpm_dlpc900::video::{exposure_us, Receiver, VideoBits, VideoPatterns};
    use std::sync::{Arc, Mutex, MutexGuard};

    const SIZE: [u32; 2] = [1920, 1080];

    /// A controller at which 24 patterns of 620 us run, their description, and the instant at which they were started.
    fn started() -> (Arc<Mutex<Dlpc900Model>>, VideoPatterns, HostTime) {
        let model = Arc::new(Mutex::new(Dlpc900Model::default()));
        let rate = FrameRate::new(60, 1).unwrap();
        let schedule = PlaneSchedule::equal_rgb24();
        let video =
            VideoPatterns::of_rig(Dmd::Dlp6500, Receiver::Hdmi, rate, &schedule, VideoBits::PLANES, 620);
        let mut d = Dlpc900::new(VirtualHid::new(model.clone())).unwrap();
        d.start_video_patterns(&video).unwrap();
        let now = d.into_port().now();
        (model, video, now)
    }

    fn lock(model: &Mutex<Dlpc900Model>) -> MutexGuard<'_, Dlpc900Model> {
        model.lock().unwrap()
    }

    /// Each pattern is one bit of the pixels, at its own time after the frame's end.
    #[test]
    fn patterns_are_cut_out_of_the_frame_that_has_arrived() {
        let (model, video, now) = started();
        let mut m = lock(&model);
        // The bits of a pixel are a function of its number.
        let word = |i: u32| (i.wrapping_mul(2_654_435_761) >> 4).to_le_bytes();
        let pixels: Vec<u8> = (0..SIZE[0] * SIZE[1]).flat_map(word).collect();
        let sync = now.plus_ns(1_000_000);
        m.video_frame(sync, SIZE, &pixels);
        let place =
            |m: &mut Dlpc900Model, us: i64| m.showing(sync.plus_ns(us * 1000)).map(|(place, _)| place);
        for k in 0..24 {
            // 620 us lit, and 64 us dark.
            assert_eq!(place(&mut m, 684 * k), Some(k as usize));
            assert_eq!(place(&mut m, 684 * k + 619), Some(k as usize));
            assert_eq!(place(&mut m, 684 * k + 620), None, "a gap after each");
        }
        for (plane, byte) in [(3, 1), (12, 2), (23, 0)] {
            let mirrors = m.projected_plane(plane).unwrap();
            for i in (0..1920 * 1080).step_by(997) {
                let lit = mirrors[i / 1920 * 240 + i % 1920 / 8] >> (7 - i % 8) & 1;
                assert_eq!(lit, pixels[4 * i + byte] >> (plane % 8) & 1);
            }
        }
        // A frame that comes before the patterns have ended aborts them. A start notices that in the dark, and ends it.
        let early = sync.plus_ns(10_000_000);
        m.video_frame(early, SIZE, &[]);
        assert_eq!(m.showing(early.plus_ns(100_000)), None);
        drop(m);
        let mut d = Dlpc900::new(VirtualHid::starting_at(model.clone(), early)).unwrap();
        assert!(d.status().unwrap().is_aborted());
        d.start_video_patterns(&video).unwrap();
        assert!(!d.status().unwrap().is_aborted());
        lock(&model).inject(Dlpc900Fault::AbortStart);
        d.start_video_patterns(&video).unwrap();
        let m = lock(&model);
        let parked = m.executed().iter().filter(|c| c.opcode == Opcode::DMD_PARK).count();
        assert_eq!((parked, m.dark_because()), (2, None), "parked and unparked once, and lit");
    }

    /// A source that is half a percent fast, as graphics cards may be, aborts no sequence, whatever the encoding. One that is
    /// ten percent fast does.
    #[test]
    fn frames_that_come_half_a_percent_early_abort_nothing() {
        let schedule = PlaneSchedule::equal_rgb24();
        for (hz, depth) in [(60, 1), (60, 2), (60, 4), (60, 8), (120, 1)] {
            let (rate, bits) = (FrameRate::new(hz, 1).unwrap(), VideoBits::new(depth).unwrap());
            let us = exposure_us(bits, Dmd::Dlp6500, rate, None).unwrap();
            let video = VideoPatterns::of_rig(Dmd::Dlp6500, Receiver::Hdmi, rate, &schedule, bits, us);
            let model = Arc::new(Mutex::new(Dlpc900Model::default()));
            let mut d = Dlpc900::new(VirtualHid::new(model.clone())).unwrap();
            d.start_video_patterns(&video).unwrap();
            let mut at = d.into_port().now().plus_ns(1_000_000);
            let mut after = |share: f64| {
                at = at.plus_ns((share * 1e9 / f64::from(hz)) as i64);
                lock(&model).video_frame(at, SIZE, &[]);
                let mut d = Dlpc900::new(VirtualHid::starting_at(model.clone(), at)).unwrap();
                d.status().unwrap().is_aborted()
            };
            let aborted = (0..20).any(|_| after(0.995));
            assert!(!aborted, "{hz} Hz, {depth} bits");
            assert!(hz != 60 || after(0.9), "{hz} Hz, {depth} bits");
        }
    }

    /// A crop that another program left cuts the picture; a start takes it away.
    #[test]
    fn a_crop_of_the_input_cuts_the_picture() {
        let (model, video, now) = started();
        let mut d = Dlpc900::new(VirtualHid::starting_at(model.clone(), now)).unwrap();
        let white = vec![0xff; 4 * (SIZE[0] * SIZE[1]) as usize];
        let lit = |model: &Mutex<Dlpc900Model>| {
            let mut m = lock(model);
            m.video_frame(now, SIZE, &white);
            m.projected_plane(0).unwrap().iter().map(|b| b.count_ones()).sum::<u32>()
        };
        let all = SIZE[0] * SIZE[1];
        for (crop, expected) in [
            ([0; 8], all),
            ([0, 0, 512, 256, 0, 0, 512, 256], 512 * 256),
            ([1910, 0, 100, 1080, 7, 3, 0, 0], 10 * 1077),
        ] {
            let data: Vec<u8> = crop.iter().flat_map(|n: &u16| n.to_le_bytes()).collect();
            d.write(Opcode::DISPLAY_RESOLUTION, &data).unwrap();
            assert_eq!(lit(&model), expected, "{crop:?}");
        }
        d.start_video_patterns(&video).unwrap();
        assert_eq!(lit(&model), all);
    }
}
