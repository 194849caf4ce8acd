//! Kinds of values that several sections use: numbers by channel, sources of pictures, and the order of bits.

use dpm_common::keys::read::{ConfigValue, KeyReader, Limit, Within};
use dpm_common::keys::source::{SourceNode, Value};
use dpm_device::planes::PlaneSchedule;
use std::fmt;
use std::path::PathBuf;

/// Red, green and blue; written as one number for all of them, or as three.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PerChannel(pub [f64; 3]);

impl ConfigValue for PerChannel {
    fn kind() -> String {
        "a number, or an array of 3".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        match node.value {
            Value::Array(_) => <[f64; 3]>::read(node, reader, key).map(Self),
            _ => f64::read(node, reader, key).map(|v| Self([v; 3])),
        }
    }

    fn show(&self) -> String {
        match self.0 {
            [r, g, b] if r == g && g == b => r.show(),
            all => all.show(),
        }
    }
}

/// Each channel within two bounds, both included.
pub(super) struct Each(pub f64, pub f64);

impl Limit<PerChannel> for Each {
    fn allows(&self, value: &PerChannel) -> bool {
        value.0.iter().all(|v| (self.0..=self.1).contains(v))
    }
    fn describe(&self) -> String {
        format!("{} to {}", self.0, self.1)
    }
}

impl Limit<Option<PerChannel>> for Each {
    fn allows(&self, value: &Option<PerChannel>) -> bool {
        value.as_ref().is_none_or(|v| self.allows(v))
    }
    fn describe(&self) -> String {
        Limit::<PerChannel>::describe(self)
    }
}

/// Which share of the projector's columns and rows is traced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RenderScale {
    /// Always this one.
    Share(f64),
    /// The largest that fits into a slot.
    Auto,
}

impl ConfigValue for RenderScale {
    fn kind() -> String {
        "a number, or \"auto\"".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        match &node.value {
            Value::String(word) if word == "auto" => Some(Self::Auto),
            _ => f64::read(node, reader, key).map(Self::Share),
        }
    }

    fn show(&self) -> String {
        match self {
            Self::Share(share) => share.show(),
            Self::Auto => format!("{:?}", "auto"),
        }
    }
}

impl Limit<RenderScale> for Within<f64> {
    fn allows(&self, value: &RenderScale) -> bool {
        match value {
            RenderScale::Share(share) => Limit::<f64>::allows(self, share),
            RenderScale::Auto => true,
        }
    }
    fn describe(&self) -> String {
        Limit::<f64>::describe(self)
    }
}

/// Where the picture on a body comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PictureSource {
    /// A file that is read once.
    File(PathBuf),
    /// Another program, while the rig runs.
    Live(LiveSource),
}

/// Where another program's pictures come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LiveSource {
    /// A named pipe, into which another program writes PPM or PAM images.
    Pipe(PathBuf),
    /// A node of PipeWire by its name or number; empty: the one that PipeWire chooses.
    PipeWire(String),
}

impl fmt::Display for PictureSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => write!(f, "{}", path.display()),
            Self::Live(source) => write!(f, "{source}"),
        }
    }
}

impl fmt::Display for LiveSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pipe(path) => write!(f, "pipe:{}", path.display()),
            Self::PipeWire(node) => write!(f, "pipewire:{node}"),
        }
    }
}

impl ConfigValue for PictureSource {
    fn kind() -> String {
        "a path, or `pipe:` and a path, or `pipewire:` and a node".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let path = PathBuf::read(node, reader, key)?;
        let text = path.to_string_lossy();
        let (source, is_sound) = match (text.strip_prefix("pipe:"), text.strip_prefix("pipewire:")) {
            (Some(path), _) => (Self::Live(LiveSource::Pipe(path.into())), !path.is_empty()),
            // It becomes a word of a command of GStreamer, whose own words are others.
            (_, Some(node)) => {
                let is_word = node.chars().all(|c| c.is_ascii_alphanumeric() || "._-:".contains(c));
                (Self::Live(LiveSource::PipeWire(node.to_owned())), is_word)
            }
            _ => (Self::File(path.clone()), !text.is_empty()),
        };
        if is_sound {
            return Some(source);
        }
        let problem = match source {
            Self::Live(LiveSource::PipeWire(_)) => {
                "is no node: names and numbers have letters, digits and the characters . _ - :"
            }
            Self::Live(LiveSource::Pipe(_)) | Self::File(_) => "names no file",
        };
        reader.refuse(&node.origin, key, problem, "");
        None
    }

    fn show(&self) -> String {
        format!("{:?}", self.to_string())
    }
}

/// The order in which a frame shows the bits of a code value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitOrder(pub [u8; 8]);

/// The three highest bits are neighbours, so that the light of any code value has nearly the same centre, and bit 4 in front
/// of them balances the low bits behind. Of the orders whose light is over early it errs least (docs/lab/ERROR.md).
impl Default for BitOrder {
    fn default() -> Self {
        Self([4, 6, 7, 5, 3, 2, 1, 0])
    }
}

impl ConfigValue for BitOrder {
    fn kind() -> String {
        "a string of eight bits".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let bits = match &node.value {
            Value::String(text) => text
                .split([' ', ','])
                .filter(|w| !w.is_empty())
                .map(|w| w.parse().ok())
                .collect::<Option<Vec<u8>>>(),
            _ => None,
        };
        let order = bits.and_then(|bits| <[u8; 8]>::try_from(bits).ok());
        let valid = order.filter(|order| PlaneSchedule::mono8_in(*order).is_some()).map(Self);
        if valid.is_none() {
            reader.refuse(
                &node.origin,
                key,
                "must name each of the bits 0 to 7 once",
                "write for example \"7 6 5 4 3 2 1 0\", whose light is over soonest",
            );
        }
        valid
    }

    fn show(&self) -> String {
        format!("{:?}", self.0.map(|bit| bit.to_string()).join(" "))
    }
}
