//! Texels that Basis Universal has compressed: ETC1S, UASTC, and ASTC, of which UASTC is a part.
//!
//! The crate `basisu` decodes them and gives the same bytes as the library of Basis Universal's authors. It trusts the
//! offsets of its file more than a program should that reads files by others. So it never sees the file itself, but one
//! written here: level 0 alone, with every part checked to be there.

use basisu::{DecodeFlags, TargetFormat, Transcoder};
use ktx2::{ColorModel, Format, Header, Index, LevelIndex, SupercompressionScheme};

use super::{damaged, unsupported, Ktx2Error, LevelContent};

/// Bytes of a block of UASTC and of ASTC.
const BLOCK_BYTES: usize = 16;
/// Bytes of the head of ETC1S's global data, and of the description of an image that follows it.
const HEAD_BYTES: usize = 20;
/// The flag of an image that only tells what has changed since the one before.
const DIFFERENCE: u32 = 2;

/// The content of a channel, as the data format descriptor numbers them.
mod channel {
    /// Red, green and blue; also the only sample of ASTC.
    pub(crate) const RGB: u8 = 0;
    /// UASTC: red, green, blue and alpha.
    pub(crate) const RGBA: u8 = 3;
    /// ETC1S: red alone, stored as grey.
    pub(crate) const ETC1S_RED: u8 = 3;
    /// UASTC: red alone, stored as grey.
    pub(crate) const UASTC_RED: u8 = 4;
    /// ETC1S: alpha in a picture of its own.
    pub(crate) const ALPHA: u8 = 15;
}

/// The texels of ETC1S, which BasisLZ always compresses further.
pub(crate) fn etc1s(content: &LevelContent) -> Result<Vec<[u8; 4]>, Ktx2Error> {
    let alpha = match content.file.descriptor.channels[..] {
        [channel::RGB | channel::ETC1S_RED] => false,
        [channel::RGB, channel::ALPHA] => true,
        _ => return Err(unsupported("of two channels, or of unknown ones")),
    };
    if content.file.header.supercompression_scheme != Some(SupercompressionScheme::BasisLZ) {
        return Err(damaged("holds ETC1S without BasisLZ, which its format forbids: export it again"));
    }
    let global = single_image(content, alpha).ok_or_else(|| {
        damaged("points outside of its own data: it is cut off or damaged, export it again")
    })?;
    let channels: &[u8] = if alpha { &[channel::RGB, channel::ALPHA] } else { &[channel::RGB] };
    let parts = LevelParts { format: None, model: ColorModel::ETC1S, block: [4, 4], channels, global };
    transcode(content, &parts, content.file.level)
}

/// The texels of UASTC.
pub(crate) fn uastc(content: &LevelContent) -> Result<Vec<[u8; 4]>, Ktx2Error> {
    let channel = match content.file.descriptor.channels[..] {
        [channel::RGB | channel::UASTC_RED] => channel::RGB,
        [channel::RGBA] => channel::RGBA,
        _ => return Err(unsupported("of two channels, or of unknown ones")),
    };
    let channels = &[channel];
    let parts =
        LevelParts { format: None, model: ColorModel::UASTC, block: [4, 4], channels, global: vec![] };
    transcode(content, &parts, &content.bytes(blocks(content, [4, 4]) * BLOCK_BYTES)?)
}

/// The texels of ASTC of low dynamic range. `format` is one of those that [`super::blocks::is_astc`] knows.
pub(crate) fn astc(content: &LevelContent, format: Format) -> Result<Vec<[u8; 4]>, Ktx2Error> {
    let block = content.file.descriptor.block;
    let channels = &[channel::RGBA];
    let parts = LevelParts { format: Some(format), model: ColorModel::ASTC, block, channels, global: vec![] };
    transcode(content, &parts, &content.bytes(blocks(content, block) * BLOCK_BYTES)?)
}

/// The number of blocks that cover the picture.
fn blocks(content: &LevelContent, [width, height]: [u32; 2]) -> usize {
    let across = content.size.width.div_ceil(width) as usize;
    across * content.size.height.div_ceil(height) as usize
}

/// The global data of ETC1S with the image of level 0 as the only one; nothing if it is not all there.
fn single_image(content: &LevelContent, alpha: bool) -> Option<Vec<u8>> {
    let header = content.file.header;
    let images = header.level_count.max(1) as usize;
    let global = content.file.global;
    let (head, rest) = global.split_at_checked(HEAD_BYTES)?;
    let (descriptions, codebooks) = rest.split_at_checked(images.checked_mul(HEAD_BYTES)?)?;
    let word = |bytes: &[u8], at: usize| Some(u32::from_le_bytes(*bytes.get(at..)?.first_chunk()?));
    let lengths = [word(head, 4)?, word(head, 8)?, word(head, 12)?];
    let needed: u64 = lengths.iter().map(|n| u64::from(*n)).sum();
    let codebooks = codebooks.get(..usize::try_from(needed).ok()?)?;
    let has_entries = head[..4].chunks_exact(2).all(|count| count != [0, 0]);
    let image = descriptions.get(..HEAD_BYTES)?;
    for slice in if alpha { &[4, 12][..] } else { &[4] } {
        let (offset, length) = (word(image, *slice)? as usize, word(image, slice + 4)? as usize);
        content.file.level.get(offset..offset.checked_add(length)?)?;
    }
    let is_whole = word(image, 0)? & DIFFERENCE == 0;
    // The last word of the head counts bytes of extensions, which nothing here reads.
    (has_entries && is_whole).then(|| [&head[..16], &[0; 4], image, codebooks].concat())
}

/// What the file for the decoder says of its only level.
struct LevelParts<'a> {
    format: Option<Format>,
    model: ColorModel,
    /// Texels along the sides of a block, 1 to 256.
    block: [u32; 2],
    /// The content of each channel.
    channels: &'a [u8],
    /// The global data.
    global: Vec<u8>,
}

impl LevelParts<'_> {
    /// A KTX2 file of the picture's size with `data` as its only level.
    fn file(&self, content: &LevelContent, data: &[u8]) -> Vec<u8> {
        let descriptor = self.descriptor();
        let descriptor_at = Header::LENGTH + LevelIndex::LENGTH;
        let global_at = descriptor_at + descriptor.len();
        let data_at = global_at + self.global.len();
        let lz = self.model == ColorModel::ETC1S;
        let header = Header {
            format: self.format,
            type_size: 1,
            pixel_width: content.size.width,
            pixel_height: content.size.height,
            pixel_depth: 0,
            layer_count: 0,
            face_count: 1,
            level_count: 1,
            supercompression_scheme: lz.then_some(SupercompressionScheme::BasisLZ),
            index: Index {
                dfd_byte_offset: descriptor_at as u32,
                dfd_byte_length: descriptor.len() as u32,
                kvd_byte_offset: 0,
                kvd_byte_length: 0,
                sgd_byte_offset: global_at as u64,
                sgd_byte_length: self.global.len() as u64,
            },
        };
        let level = LevelIndex {
            byte_offset: data_at as u64,
            byte_length: data.len() as u64,
            uncompressed_byte_length: if lz { 0 } else { data.len() as u64 },
        };
        [&header.as_bytes()[..], &level.as_bytes(), &descriptor, &self.global, data].concat()
    }

    /// The data format descriptor: its own length, six words of a basic block, four words for each channel.
    fn descriptor(&self) -> Vec<u8> {
        let block_bytes = 24 + 16 * self.channels.len() as u32;
        let [width, height] = self.block.map(|side| side - 1);
        // Version 2 of the block; primaries of BT.709 and a linear transfer, neither of which changes the texels.
        let model = u32::from(self.model.value()) | 1 << 8 | 1 << 16;
        let mut words = vec![block_bytes + 4, 0, 2 | block_bytes << 16, model, width | height << 8, 0, 0];
        for (i, channel) in (0..).zip(self.channels) {
            words.extend([(64 * i) | 63 << 16 | u32::from(*channel) << 24, 0, 0, u32::MAX]);
        }
        words.into_iter().flat_map(u32::to_le_bytes).collect()
    }
}

/// Decodes `data` as the level of a file with these parts.
fn transcode(content: &LevelContent, parts: &LevelParts, data: &[u8]) -> Result<Vec<[u8; 4]>, Ktx2Error> {
    // What the decoder calls the error says no more: it gives the same one for all damage.
    let failed = |_| damaged("cannot be decoded: its data is damaged, export it again");
    let file = parts.file(content, data);
    let texture = Transcoder::new(&file).map_err(failed)?;
    let mut texels = vec![[0; 4]; content.size.texels()];
    // The filter would smooth the edges of large blocks, which no other program does.
    let flags = DecodeFlags::NO_DEBLOCK_FILTERING;
    texture
        .transcode_into(0, TargetFormat::Rgba32, flags, bytemuck::cast_slice_mut(&mut texels))
        .map_err(failed)?;
    Ok(texels)
}
