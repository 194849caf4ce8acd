//! Kinds of values that several sections use: numbers by channel, and the order of axes.

use dpm_common::keys::read::{ConfigValue, Limit, Reader};
use dpm_common::keys::source::{Node, Value};
use dpm_device::planes::PlaneSchedule;
use glam::{DMat3, DVec3};
use std::fmt;
use std::path::PathBuf;

/// Red, green and blue; written as one number for all of them, or as three.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PerChannel(pub [f64; 3]);

impl ConfigValue for PerChannel {
    fn kind() -> String {
        "a number, or an array of 3".into()
    }

    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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

    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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

    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
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

/// Which axes of the tracker point along the world's x, y and z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axes(DMat3);

impl Default for Axes {
    fn default() -> Self {
        Self(DMat3::IDENTITY)
    }
}

impl Axes {
    /// The matrix that takes the tracker's coordinates to the world's: one entry of 1 or -1 in each row and column. Its
    /// determinant is -1 if the tracker is left-handed.
    pub fn matrix(&self) -> DMat3 {
        self.0
    }

    /// From a text such as "x z -y".
    fn parse(text: &str) -> Option<Self> {
        let mut rows = [DVec3::ZERO; 3];
        let mut words = text.split([' ', ',']).filter(|w| !w.is_empty());
        for row in &mut rows {
            let word = words.next()?;
            let (sign, axis) = match word.strip_prefix('-') {
                Some(axis) => (-1.0, axis),
                None => (1.0, word.strip_prefix('+').unwrap_or(word)),
            };
            let axis = match axis {
                "x" | "X" => DVec3::X,
                "y" | "Y" => DVec3::Y,
                "z" | "Z" => DVec3::Z,
                _ => return None,
            };
            *row = axis * sign;
        }
        let matrix = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
        (words.next().is_none() && matrix.determinant() != 0.0).then_some(Self(matrix))
    }
}

impl ConfigValue for Axes {
    fn kind() -> String {
        "a string of three axes".into()
    }

    fn read(node: &Node, reader: &mut Reader, key: &str) -> Option<Self> {
        let parsed = match &node.value {
            Value::String(text) => Self::parse(text),
            _ => None,
        };
        if parsed.is_none() {
            reader.refuse(
                &node.origin,
                key,
                "must name each of x, y and z once, with or without a sign",
                "write for example \"x z -y\" for a tracker whose z points up",
            );
        }
        parsed
    }

    fn show(&self) -> String {
        let name = |row: DVec3| {
            let axis = ["x", "y", "z"][row.abs().to_array().iter().position(|v| *v > 0.5).unwrap_or(0)];
            format!("{}{axis}", if row.element_sum() < 0.0 { "-" } else { "" })
        };
        let rows = self.0.transpose();
        format!("\"{} {} {}\"", name(rows.x_axis), name(rows.y_axis), name(rows.z_axis))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_a_signed_exchange_that_reads_as_it_is_written() {
        let z_up = Axes::parse("x z -y").unwrap();
        assert_eq!(z_up.matrix() * DVec3::new(1.0, 2.0, 3.0), DVec3::new(1.0, 3.0, -2.0));
        assert_eq!(z_up.matrix().determinant(), 1.0);
        assert_eq!(Axes::parse("x y -z").unwrap().matrix().determinant(), -1.0);
        for text in ["\"x y z\"", "\"-z x y\"", "\"x z -y\""] {
            assert_eq!(Axes::parse(text.trim_matches('"')).unwrap().show(), text);
        }
        for wrong in ["", "x y", "x y z x", "x x y", "x y w", "x -y --z"] {
            assert_eq!(Axes::parse(wrong), None, "{wrong}");
        }
    }
}
