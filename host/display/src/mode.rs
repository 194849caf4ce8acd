//! The timing of a display's signal: its exact frame rate, and how a rig file names it.

use std::fmt;
use std::str::FromStr;

use dpm_device::time::FrameRate;

/// A mode of a display: what its signal looks like in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// Pixel clock, kHz.
    pub clock_khz: u32,
    /// Of a row, in pixels: the picture, the start and the end of the synchronisation pulse, everything.
    pub row: [u16; 4],
    /// Of a frame, in rows: the same.
    pub frame: [u16; 4],
    /// Flags of the kernel (`DRM_MODE_FLAG_*`): the polarity of the pulses, interlacing and so on.
    pub flags: u32,
}

/// Horizontal and vertical pulses are positive or negative.
const PULSES: [(&str, u32); 4] = [("+hsync", 1), ("-hsync", 2), ("+vsync", 4), ("-vsync", 8)];
/// Flags of modes that do not scan every row once, in order: interlaced, scanned twice, 3D.
const UNUSUAL: u32 = 0x10 | 0x20 | 0x1f_c000;

impl Timing {
    /// Frames a second: pixel clock / (pixels of a row x rows of a frame), in lowest terms. `None` for a mode without
    /// rows, pixels or clock.
    pub fn rate(&self) -> Option<FrameRate> {
        let (num, den) =
            (u64::from(self.clock_khz) * 1000, u64::from(self.row[3]) * u64::from(self.frame[3]));
        if num == 0 || den == 0 {
            return None;
        }
        let gcd = gcd(num, den);
        FrameRate::new(u32::try_from(num / gcd).ok()?, u32::try_from(den / gcd).ok()?)
    }

    /// Columns and rows of the picture.
    pub const fn size(&self) -> (u32, u32) {
        (self.row[0] as u32, self.frame[0] as u32)
    }

    /// True if every row is scanned once, from top to bottom.
    pub const fn is_progressive(&self) -> bool {
        self.flags & UNUSUAL == 0
    }

    /// From the first pixel of a frame to the end of its last row, nanoseconds: how long the picture rolls.
    pub fn scan_ns(&self) -> i64 {
        self.rows_ns(self.frame[0])
    }

    /// From the first pixel of a frame to the vertical pulse after its last row, nanoseconds.
    pub fn pulse_ns(&self) -> i64 {
        self.rows_ns(self.frame[1])
    }

    fn rows_ns(&self, rows: u16) -> i64 {
        i64::from(rows) * i64::from(self.row[3]) * 1_000_000 / i64::from(self.clock_khz).max(1)
    }
}

impl fmt::Display for Timing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hz = self.rate().map_or(0.0, FrameRate::hz);
        write!(f, "{}x{}@{hz:.3}", self.row[0], self.frame[0])
    }
}

fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 {
        a
    } else {
        gcd(b, a % b)
    }
}

/// A rate as a rig file writes it.
pub fn written(rate: FrameRate) -> String {
    if rate.den() == 1 {
        format!("{:?}", rate.num().to_string())
    } else {
        format!("\"{}/{}\"", rate.num(), rate.den())
    }
}

/// What a rig file asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModeWish {
    /// A mode that the display offers, by its size and, in thousandths of a hertz, by its rate; the display's first of
    /// that size if no rate is named.
    Named {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Frames in a thousand seconds.
        millihertz: Option<u32>,
    },
    /// A timing of one's own, whatever the display offers.
    Exactly(Timing),
}

/// Why a text is no mode.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "must be a size with or without a rate (\"1920x1080@60\"), or a timing: pixel clock in MHz, four numbers of the row, four of the \
     frame, and the pulses (\"138.5 1920 1968 2000 2080 1080 1083 1088 1111 +hsync -vsync\")"
)]
pub struct NoMode;

impl FromStr for ModeWish {
    type Err = NoMode;

    fn from_str(text: &str) -> Result<Self, NoMode> {
        if text.contains(' ') {
            return timing(text).ok_or(NoMode).map(Self::Exactly);
        }
        let (size, rate) = text.split_once('@').map_or((text, None), |(size, rate)| (size, Some(rate)));
        let (width, height) = size.split_once('x').ok_or(NoMode)?;
        let side = |text: &str| text.parse::<u16>().ok().filter(|n| *n > 0).map(u32::from).ok_or(NoMode);
        let millihertz = rate.map(|rate| thousandths(rate).filter(|n| *n > 0).ok_or(NoMode)).transpose()?;
        Ok(Self::Named { width: side(width)?, height: side(height)?, millihertz })
    }
}

/// A decimal number with at most three places, in thousandths.
fn thousandths(text: &str) -> Option<u32> {
    let (whole, part) = text.split_once('.').unwrap_or((text, ""));
    if part.len() > 3 || !whole.bytes().chain(part.bytes()).all(|b| b.is_ascii_digit()) {
        return None;
    }
    let part: u32 = format!("{part:0<3}").parse().ok()?;
    whole.parse::<u32>().ok()?.checked_mul(1000)?.checked_add(part)
}

fn timing(text: &str) -> Option<Timing> {
    let mut words = text.split_ascii_whitespace();
    let clock_khz = thousandths(words.next()?).filter(|n| *n > 0)?;
    let mut four = || -> Option<[u16; 4]> {
        let mut all = [0; 4];
        for one in &mut all {
            *one = words.next()?.parse().ok()?;
        }
        // The parts follow each other.
        (all[0] > 0 && all[0] <= all[1] && all[1] < all[2] && all[2] <= all[3]).then_some(all)
    };
    let (row, frame) = (four()?, four()?);
    let mut flags = 0;
    for word in words {
        flags |= PULSES.iter().find(|(name, _)| name.eq_ignore_ascii_case(word))?.1;
    }
    if flags & 3 == 0 {
        flags |= 1;
    }
    if flags & 12 == 0 {
        flags |= 4;
    }
    (flags & 3 != 3 && flags & 12 != 12).then_some(Timing { clock_khz, row, frame, flags })
}

impl ModeWish {
    /// The timing of this mode on a display that offers `modes`.
    ///
    /// # Errors
    /// The display offers none that is meant; the text lists those of the size, or all sizes.
    pub fn choose(&self, modes: &[Timing]) -> Result<Timing, String> {
        let Self::Named { width, height, millihertz } = *self else {
            let Self::Exactly(timing) = *self else { unreachable!("the other kind") };
            return Ok(timing);
        };
        let fits = |m: &&Timing| m.size() == (width, height) && m.is_progressive() && m.rate().is_some();
        let distance = |m: &Timing| {
            let hz = m.rate().map_or(0.0, FrameRate::hz);
            millihertz.map_or(0.0, |wish| (hz - f64::from(wish) * 1e-3).abs())
        };
        let nearest = modes.iter().filter(fits).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        if let Some(mode) = nearest.filter(|m| distance(m) < 0.5) {
            return Ok(*mode);
        }
        let mut offered: Vec<String> = modes.iter().filter(fits).map(Timing::to_string).collect();
        if offered.is_empty() {
            offered = modes.iter().filter(|m| m.is_progressive()).map(Timing::to_string).collect();
        }
        offered.dedup();
        offered.truncate(12);
        Err(if offered.is_empty() {
            "the display offers no mode at all; write its timing as projector.backend.mode".into()
        } else {
            format!(
                "the display does not offer it, but {}; write one of these, or a timing",
                offered.join(", ")
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) const FULL_HD: Timing = Timing {
        clock_khz: 148_500,
        row: [1920, 2008, 2052, 2200],
        frame: [1080, 1084, 1089, 1125],
        flags: 5,
    };

    #[test]
    fn the_rate_of_a_mode_is_exact() {
        assert_eq!(FULL_HD.rate(), FrameRate::new(60, 1));
        let ntsc = Timing { clock_khz: 148_352, ..FULL_HD };
        // 148,352,000 / 2,475,000 in lowest terms.
        assert_eq!(ntsc.rate(), FrameRate::new(148_352, 2_475));
        assert_eq!(written(ntsc.rate().unwrap()), "\"148352/2475\"");
        assert_eq!(written(FULL_HD.rate().unwrap()), "\"60\"");
        // CVT with reduced blanking, as a DLPC900 takes it.
        let text = "138.51 1920 1968 2000 2080 1080 1083 1088 1111 +hsync -vsync";
        let ModeWish::Exactly(cvt) = text.parse().unwrap() else { panic!("{text}") };
        assert_eq!((cvt.clock_khz, cvt.flags, cvt.row[3], cvt.frame[3]), (138_510, 1 | 8, 2080, 1111));
        assert!((cvt.rate().unwrap().hz() - 59.938).abs() < 1e-3);
        assert_eq!(Timing { clock_khz: 0, ..FULL_HD }.rate(), None);
        // 1080 of 1125 rows of a sixtieth of a second.
        assert_eq!(FULL_HD.scan_ns(), 16_000_000);
    }

    #[test]
    fn a_mode_is_chosen_by_its_size_and_the_nearest_rate() {
        let ntsc = Timing { clock_khz: 148_352, ..FULL_HD };
        let fast = Timing { clock_khz: 297_000, ..FULL_HD };
        let interlaced = Timing { flags: 0x10, ..FULL_HD };
        let modes = [interlaced, ntsc, FULL_HD, fast];
        let chosen = |text: &str| text.parse::<ModeWish>().unwrap().choose(&modes);
        assert_eq!(chosen("1920x1080@60"), Ok(FULL_HD));
        assert_eq!(chosen("1920x1080@59.94"), Ok(ntsc));
        assert_eq!(chosen("1920x1080@120"), Ok(fast));
        assert_eq!(chosen("1920x1080"), Ok(ntsc), "the first that is scanned row by row");
        let refused = chosen("1920x1080@75").unwrap_err();
        assert!(refused.contains("1920x1080@59.940") && refused.contains("timing"), "{refused}");
        assert!(chosen("1024x768@60").unwrap_err().contains("1920x1080@60.000"));
        assert!(ModeWish::from_str("800x600").unwrap().choose(&[]).unwrap_err().contains("no mode at all"));
    }

    #[test]
    fn what_is_no_mode_is_refused() {
        for text in [
            "",
            "x",
            "1920x",
            "0x10",
            "1920x1080@",
            "1920x1080@x",
            "1920x1080@60.0001",
            "1920x1080@0",
            "99999x10",
            "138.5 1920 1968 2000 2080 1080 1083 1088",
            "138.5 1920 1968 2000 1980 1080 1083 1088 1111",
            "138.5 1920 1968 2000 2080 1080 1083 1088 1111 +hsync -hsync",
            "0 1920 1968 2000 2080 1080 1083 1088 1111",
            "138.5 1920 1968 2000 2080 1080 1083 1088 1111 and more",
        ] {
            assert_eq!(text.parse::<ModeWish>(), Err(NoMode), "{text}");
        }
    }
}
