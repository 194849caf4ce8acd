//! `projector.backend.compaction`: the codecs of a link.

use dpm_common::keys::read::{ConfigValue, KeyReader};
use dpm_common::keys::source::{SourceNode, Value};
use dpm_device::link::Codec;

/// The codecs that a link may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compaction {
    /// All that both sides support.
    Auto,
    /// Those of this mask, as bits of [`Codec::mask`], and raw. With raw alone every plane of every frame is sent.
    Only(u32),
}

impl Compaction {
    /// Every plane as it is.
    pub const RAW: Self = Self::Only(0);
    /// Names of the codecs in lists.
    const WORDS: [(&'static str, Codec); 4] =
        [("raw", Codec::Raw), ("rle", Codec::Rle), ("xor-rle", Codec::XorRle), ("lz4", Codec::Lz4)];
}

impl Compaction {
    /// Its codecs, as bits of [`Codec::mask`].
    pub const fn codecs(self) -> u32 {
        match self {
            Self::Auto => Codec::ALL,
            Self::Only(mask) => mask | Codec::Raw.mask(),
        }
    }
}

impl ConfigValue for Compaction {
    fn kind() -> String {
        r#""auto" | "raw" | a list of "rle", "xor-rle", "lz4""#.into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let word = |node: &SourceNode| match &node.value {
            Value::String(s) => Self::WORDS.iter().find(|(word, _)| word == s).map(|(_, codec)| codec.mask()),
            _ => None,
        };
        let mask = match &node.value {
            Value::String(s) if s == "auto" => return Some(Self::Auto),
            Value::Array(list) => list.iter().map(word).try_fold(0, |mask, one| Some(mask | one?)),
            _ => word(node),
        };
        match mask {
            Some(mask) => Some(Self::Only(mask & !Codec::Raw.mask())),
            None => {
                reader.refuse(&node.origin, key, format!("must be {}", Self::kind()), "");
                None
            }
        }
    }

    fn show(&self) -> String {
        match self {
            Self::Auto => "\"auto\"".into(),
            Self::Only(0) => "\"raw\"".into(),
            Self::Only(mask) => {
                let words = Self::WORDS.iter().filter(|(_, codec)| mask & codec.mask() != 0);
                format!("[{}]", words.map(|(word, _)| format!("{word:?}")).collect::<Vec<_>>().join(", "))
            }
        }
    }
}
