//! What a fake camera is, and its notation in text.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::PathBuf;

/// How pictures are stamped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stamp {
    /// CLOCK_MONOTONIC, the begin of the exposure.
    Begin,
    /// CLOCK_MONOTONIC, the end of the picture.
    End,
    /// CLOCK_MONOTONIC, a moment that no header names.
    OddMoment,
    /// A clock that is not named.
    NoClock,
    /// Stamps of another program.
    Copied,
    /// CLOCK_REALTIME, though the flags name CLOCK_MONOTONIC.
    WallClock,
}

/// A fake camera.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Its device file, which need not exist.
    pub path: PathBuf,
    /// Where its pictures come from.
    pub from: SocketAddr,
    /// Its model.
    pub card: String,
    /// Columns and rows.
    pub size: [u32; 2],
    /// Its formats, by their four characters.
    pub formats: Vec<String>,
    /// Pictures per second that it offers; the first is its own.
    pub rates: Vec<u32>,
    /// How it stamps.
    pub stamp: Stamp,
    /// What the control for its exposure may be, in 100 us; `None` without one.
    pub exposure: Option<RangeInclusive<i32>>,
    /// It can expose by itself, and does so when it is plugged in.
    pub is_automatic: bool,
    /// What its gain may be; `None` without a control.
    pub gain: Option<RangeInclusive<i32>>,
    /// `V4L2_CAP_...` of the device file.
    pub capabilities: u32,
    /// Bytes behind each row.
    pub padding: u32,
    /// Requests that fail, by their names without `VIDIOC_`, with errno.
    pub failures: BTreeMap<String, i32>,
    /// Another program streams.
    pub is_busy: bool,
    /// This user may not open it.
    pub is_denied: bool,
    /// It streams and gives no picture.
    pub is_silent: bool,
    /// Each n-th picture is marked as damaged; 0: none.
    pub damaged_every: u32,
    /// Each n-th picture is a row too short; 0: none.
    pub short_every: u32,
}

impl Settings {
    /// Reads words with spaces between them. `path=`, `from=HOST:PORT` and `size=WxH` must be there. `card=` (`_` stands for a
    /// space), `formats=GREY,YUYV`, `rates=60,30`, `stamp=` (`begin`, `end`, `odd-moment`, `no-clock`, `copied`, `wall-clock`),
    /// `exposure=LEAST..MOST` or `none`, `automatic`, `gain=LEAST..MOST`, `capabilities=0x...`, `padding=`,
    /// `fails=S_FMT:EBUSY,QBUF:EIO`, `busy`, `denied`, `silent`, `damaged=N`, `short=N`.
    ///
    /// # Errors
    /// The word that is not understood.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut all = Self {
            path: PathBuf::new(),
            from: SocketAddr::from(([127, 0, 0, 1], 1)),
            card: "Fake camera".into(),
            size: [0, 0],
            formats: vec!["GREY".into()],
            rates: vec![60, 30],
            stamp: Stamp::Begin,
            exposure: Some(1..=5_000),
            is_automatic: false,
            gain: None,
            // VIDEO_CAPTURE, STREAMING.
            capabilities: 0x0400_0001,
            padding: 16,
            failures: BTreeMap::new(),
            is_busy: false,
            is_denied: false,
            is_silent: false,
            damaged_every: 0,
            short_every: 0,
        };
        for word in text.split_whitespace() {
            all.set(word).ok_or_else(|| format!("fake-v4l2: {word:?} is not understood"))?;
        }
        if all.path.as_os_str().is_empty() || all.size[0] == 0 {
            return Err(format!("fake-v4l2: {text:?} has no path or no size"));
        }
        Ok(all)
    }

    fn set(&mut self, word: &str) -> Option<()> {
        let (name, value) = word.split_once('=').unwrap_or((word, ""));
        match name {
            "path" => self.path = value.into(),
            "from" => self.from = value.parse().ok()?,
            "card" => self.card = value.replace('_', " "),
            "size" => {
                let (w, h) = value.split_once('x')?;
                self.size = [w.parse().ok()?, h.parse().ok()?];
            }
            "formats" => self.formats = value.split(',').map(|f| format!("{f:<4}")).collect(),
            "rates" => self.rates = value.split(',').map(|r| r.parse().ok()).collect::<Option<_>>()?,
            "stamp" => {
                self.stamp = match value {
                    "begin" => Stamp::Begin,
                    "end" => Stamp::End,
                    "odd-moment" => Stamp::OddMoment,
                    "no-clock" => Stamp::NoClock,
                    "copied" => Stamp::Copied,
                    "wall-clock" => Stamp::WallClock,
                    _ => return None,
                }
            }
            "exposure" => self.exposure = if value == "none" { None } else { Some(range(value)?) },
            "automatic" => self.is_automatic = true,
            "gain" => self.gain = Some(range(value)?),
            "capabilities" => {
                self.capabilities = u32::from_str_radix(value.strip_prefix("0x")?, 16).ok()?;
            }
            "padding" => self.padding = value.parse().ok()?,
            "fails" => {
                for pair in value.split(',') {
                    let (call, errno) = pair.split_once(':')?;
                    self.failures.insert(call.into(), number(errno)?);
                }
            }
            "busy" => self.is_busy = true,
            "denied" => self.is_denied = true,
            "silent" => self.is_silent = true,
            "damaged" => self.damaged_every = value.parse().ok()?,
            "short" => self.short_every = value.parse().ok()?,
            _ => return None,
        }
        Some(())
    }
}

fn range(text: &str) -> Option<RangeInclusive<i32>> {
    let (least, most) = text.split_once("..")?;
    Some(least.parse().ok()?..=most.parse().ok()?)
}

fn number(errno: &str) -> Option<i32> {
    Some(match errno {
        "EIO" => libc::EIO,
        "EBUSY" => libc::EBUSY,
        "EINVAL" => libc::EINVAL,
        "ENODEV" => libc::ENODEV,
        "ENOMEM" => libc::ENOMEM,
        "ENOTTY" => libc::ENOTTY,
        "EACCES" => libc::EACCES,
        "EPROTO" => libc::EPROTO,
        "ENOSPC" => libc::ENOSPC,
        "EINTR" => libc::EINTR,
        _ => return None,
    })
}
