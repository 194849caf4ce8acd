//! A sequence of binary pictures in the panel's memory: data, controls and timing.

use std::sync::Arc;

use crate::codes::*;
use crate::Settings;

/// Shortest dark time after a picture in the normal mode, microseconds.
const DARK_US: i32 = 44;
/// Picture time of a sequence of which the timing was not set, microseconds.
const DEFAULT_PICTURE_US: i32 = 33_334;

/// The timing in force: set by `AlpSeqTiming`, which also puts the binary mode in force.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Timing {
    pub picture_us: i32,
    pub illuminate_us: i32,
    pub uninterrupted: bool,
}

impl Timing {
    /// How long a picture gives light.
    pub(crate) fn light_us(&self) -> i32 {
        if self.uninterrupted {
            self.picture_us
        } else {
            self.illuminate_us
        }
    }
}

#[derive(Debug)]
pub(crate) struct Sequence {
    pub pictures: u32,
    planes: Vec<Arc<[u8]>>,
    pub repeat: u32,
    pub first: u32,
    pub last: u32,
    bin_mode: i32,
    pub format: i32,
    put_lock: i32,
    pub active: Timing,
    limits: (i32, i32),
}

impl Sequence {
    pub(crate) fn new(settings: &Settings, pictures: u32) -> Self {
        // What the memory held before is not defined: light, so that a driver that shows it is caught.
        let noise: Arc<[u8]> = vec![0xa5; settings.plane_bytes()].into();
        Self {
            pictures,
            planes: vec![noise; pictures as usize],
            repeat: 1,
            first: 0,
            last: pictures - 1,
            bin_mode: BIN_NORMAL,
            format: 0,
            put_lock: 0,
            active: Timing {
                picture_us: DEFAULT_PICTURE_US,
                illuminate_us: DEFAULT_PICTURE_US - DARK_US,
                uninterrupted: false,
            },
            limits: (settings.min_picture_us, settings.max_picture_us),
        }
    }

    pub(crate) fn picture(&self, number: u32) -> Arc<[u8]> {
        self.planes[number as usize].clone()
    }

    pub(crate) fn pictures_shown(&self) -> u32 {
        self.last - self.first + 1
    }

    /// Whether its data may be written while it is shown.
    pub(crate) fn is_locked(&self) -> bool {
        self.put_lock == 0
    }

    /// Shortest picture time in the binary mode that is asked for.
    fn min_picture_us(&self) -> i32 {
        match self.bin_mode {
            BIN_UNINTERRUPTED => self.limits.0,
            _ => self.limits.0 + DARK_US,
        }
    }

    pub(crate) fn control(&mut self, what: i32, value: i32) -> i32 {
        let picture = u32::try_from(value).ok().filter(|n| *n < self.pictures);
        match (what, value) {
            (SEQ_REPEAT, 1..=1_048_576) => self.repeat = value as u32,
            (FIRSTFRAME, _) if picture.is_some_and(|n| n <= self.last) => self.first = value as u32,
            (LASTFRAME, _) if picture.is_some_and(|n| n >= self.first) => self.last = value as u32,
            (BITNUM, 1) => {}
            (BIN_MODE, BIN_NORMAL | BIN_UNINTERRUPTED) => self.bin_mode = value,
            (DATA_FORMAT, 0..=3) => self.format = value,
            (SEQ_PUT_LOCK, _) => self.put_lock = value,
            _ => return PARM_INVALID,
        }
        OK
    }

    pub(crate) fn inquire(&self, what: i32) -> Result<i32, i32> {
        Ok(match what {
            SEQ_REPEAT => self.repeat as i32,
            FIRSTFRAME => self.first as i32,
            LASTFRAME => self.last as i32,
            BITNUM | BITPLANES => 1,
            BIN_MODE => self.bin_mode,
            DATA_FORMAT => self.format,
            PICNUM => self.pictures as i32,
            PICTURE_TIME => self.active.picture_us,
            ILLUMINATE_TIME => self.active.illuminate_us,
            MIN_PICTURE_TIME => self.min_picture_us(),
            MIN_ILLUMINATE_TIME => self.limits.0,
            MAX_PICTURE_TIME => self.limits.1,
            _ => return Err(PARM_INVALID),
        })
    }

    pub(crate) fn set_timing(&mut self, illuminate_us: i32, picture_us: i32, pulse_us: i32) -> i32 {
        let uninterrupted = self.bin_mode == BIN_UNINTERRUPTED;
        let picture = if picture_us == 0 { DEFAULT_PICTURE_US } else { picture_us };
        let most = if uninterrupted { picture } else { picture - DARK_US };
        let illuminate = if illuminate_us == 0 { most } else { illuminate_us };
        let is_good = (self.min_picture_us()..=self.limits.1).contains(&picture)
            && (self.limits.0..=most).contains(&illuminate)
            && (0..picture).contains(&pulse_us);
        if !is_good {
            return PARM_INVALID;
        }
        self.active = Timing { picture_us: picture, illuminate_us: illuminate, uninterrupted };
        OK
    }

    pub(crate) fn put(&mut self, number: u32, plane: &[u8]) {
        self.planes[number as usize] = plane.into();
    }
}
