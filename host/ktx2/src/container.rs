//! The parts of a KTX2 file: its head, what it says of its texels, and the bytes of level 0.
//!
//! Words and lists are those of the crate `ktx2`. Its reader of whole files is not used, since it adds one to a byte of
//! the file that may be 255.

use ktx2::dfd::DataFormatFlags;
use ktx2::{ColorModel, Header, KeyValueDataIterator, LevelIndex, TransferFunction};

/// What a file says of its texels: the basic block of its data format descriptor.
pub(crate) struct Descriptor {
    /// How channels make a colour.
    pub model: Option<ColorModel>,
    /// How numbers stand for light.
    pub transfer: Option<TransferFunction>,
    /// Colours are multiplied by alpha.
    pub premultiplied: bool,
    /// Texels along the sides of a block, 1 to 256.
    pub block: [u32; 2],
    /// The content of each channel, by the numbers of the model.
    pub channels: Vec<u8>,
}

/// A KTX2 file whose parts are all there.
pub(crate) struct File<'a> {
    /// Format, size and shape.
    pub header: Header,
    /// What the texels mean.
    pub descriptor: Descriptor,
    /// What the supercompression needs for all levels.
    pub global: &'a [u8],
    /// Level 0, as it is stored.
    pub level: &'a [u8],
    notes: &'a [u8],
}

impl<'a> File<'a> {
    /// The parts of a file; nothing if it is cut off, or if an offset points out of it.
    pub(crate) fn of(bytes: &'a [u8]) -> Option<Self> {
        let header = Header::from_bytes(bytes.first_chunk()?).ok()?;
        let levels = (header.level_count.max(1) as usize).checked_mul(LevelIndex::LENGTH)?;
        let index = bytes.get(Header::LENGTH..)?.get(..levels)?;
        let level = LevelIndex::from_bytes(index.first_chunk()?);
        let at = header.index;
        let part = |offset: u64, length: u64| {
            let end = usize::try_from(offset.checked_add(length)?).ok()?;
            bytes.get(usize::try_from(offset).ok()?..end)
        };
        Some(Self {
            header,
            descriptor: Descriptor::of(part(at.dfd_byte_offset.into(), at.dfd_byte_length.into())?)?,
            global: part(at.sgd_byte_offset, at.sgd_byte_length)?,
            level: part(level.byte_offset, level.byte_length)?,
            notes: part(at.kvd_byte_offset.into(), at.kvd_byte_length.into())?,
        })
    }

    /// A note by the program that wrote the file, without the zero at its end.
    pub(crate) fn note(&self, key: &str) -> Option<String> {
        let (_, value) = KeyValueDataIterator::new(self.notes).find(|(name, _)| *name == key)?;
        Some(String::from_utf8_lossy(value).trim_end_matches('\0').to_owned())
    }
}

impl Descriptor {
    /// Reads a data format descriptor, whose first block is the basic one.
    fn of(bytes: &[u8]) -> Option<Self> {
        // The length of all blocks, then of the first one its kind, 0, its version and its length.
        let (head, rest) = bytes.split_at_checked(12)?;
        let length = usize::from(u16::from_le_bytes([head[10], head[11]])).checked_sub(8)?;
        let (fixed, samples) = rest.get(..length)?.split_at_checked(16)?;
        if head[4..8] != [0; 4] || samples.len() % 16 != 0 {
            return None;
        }
        let [model, _, transfer, flags, width, height, ..] = *fixed else { return None };
        Some(Self {
            model: ColorModel::new(model),
            transfer: TransferFunction::new(transfer),
            premultiplied: DataFormatFlags::from_bits_truncate(flags)
                .contains(DataFormatFlags::ALPHA_PREMULTIPLIED),
            block: [width, height].map(|side| u32::from(side) + 1),
            channels: samples.chunks_exact(16).map(|sample| sample[3] & 15).collect(),
        })
    }
}
