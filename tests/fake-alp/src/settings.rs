//! The properties of a fake panel, and their notation in text.

/// What a panel is made of. [`Settings::default`] is a V-7001: 1024 x 768 mirrors, 22,727 binary pictures a second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Mirrors in a row.
    pub width: u32,
    /// Rows of mirrors.
    pub height: u32,
    /// `ALP_DEV_DMDTYPE` that it answers.
    pub dmd_type: i32,
    /// Memory for sequences in binary pictures.
    pub memory: u32,
    /// Places for waiting sequences in the queue.
    pub queue: u32,
    /// Shortest time from a picture to the next, microseconds.
    pub min_picture_us: i32,
    /// Longest time from a picture to the next, microseconds.
    pub max_picture_us: i32,
    /// Bytes a second that its cable carries.
    pub usb_bytes_per_s: f64,
    /// Time that every call takes, microseconds.
    pub call_us: u32,
    /// From the call that starts a sequence to its first picture, if nothing else is shown, microseconds.
    pub start_us: u32,
    /// From `AlpProjHalt` to the end of the light, microseconds.
    pub halt_us: u32,
    /// How much faster its clock runs than the host's, parts per million.
    pub clock_ppm: f64,
    /// The mirrors keep the last picture when nothing follows it. Whether a real panel does is not documented, so a driver must be right
    /// with both.
    pub keeps_last: bool,
    /// All three temperatures, degrees Celsius.
    pub celsius: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            width: 1024,
            height: 768,
            dmd_type: 4,
            memory: 43_690,
            queue: 64,
            min_picture_us: 44,
            max_picture_us: 10_000_000,
            usb_bytes_per_s: 350e6,
            call_us: 30,
            start_us: 100,
            halt_us: 10_000,
            clock_ppm: 0.0,
            keeps_last: true,
            celsius: 40.0,
        }
    }
}

impl Settings {
    /// Bytes of a binary picture, rows padded to whole bytes.
    pub fn plane_bytes(&self) -> usize {
        self.width.div_ceil(8) as usize * self.height as usize
    }

    /// Reads `NAME=VALUE` pairs with commas between them, for example `size=64x48,memory=100,queue=8,ppm=-40`. The names are `size`,
    /// `memory`, `queue`, `min`, `max` (microseconds), `usb` (bytes/s), `call`, `start`, `halt` (microseconds), `ppm`, `keeps` (0 or 1),
    /// `celsius`, `type`.
    ///
    /// # Errors
    /// The pair that is not understood.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut all = Self::default();
        for pair in text.split(',').map(str::trim).filter(|pair| !pair.is_empty()) {
            all.set(pair).ok_or_else(|| format!("fake-alp: {pair:?} is not understood"))?;
        }
        Ok(all)
    }

    fn set(&mut self, pair: &str) -> Option<()> {
        let (name, value) = pair.split_once('=')?;
        match name {
            "size" => {
                let (w, h) = value.split_once('x')?;
                (self.width, self.height) = (w.parse().ok()?, h.parse().ok()?);
            }
            "memory" => self.memory = value.parse().ok()?,
            "queue" => self.queue = value.parse().ok()?,
            "min" => self.min_picture_us = value.parse().ok()?,
            "max" => self.max_picture_us = value.parse().ok()?,
            "usb" => self.usb_bytes_per_s = value.parse().ok()?,
            "call" => self.call_us = value.parse().ok()?,
            "start" => self.start_us = value.parse().ok()?,
            "halt" => self.halt_us = value.parse().ok()?,
            "ppm" => self.clock_ppm = value.parse().ok()?,
            "keeps" => self.keeps_last = value == "1",
            "celsius" => self.celsius = value.parse().ok()?,
            "type" => self.dmd_type = value.parse().ok()?,
            _ => return None,
        }
        Some(())
    }
}
