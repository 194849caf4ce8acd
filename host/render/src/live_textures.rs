//! Textures that show what another program makes: from its newest picture into the GPU's memory, a piece a frame.
//!
//! A texture has [`PLACES`] places among the texels of the scene. One is shown. A new picture goes into a place that no
//! frame in flight reads, and is shown from the frame on that copies its last piece. So a frame shows one picture
//! as a whole, and copies a bounded number of texels, however large pictures are and however many come.

use crate::gpu::{Buffer, CommandList, Gpu, GpuError, MemoryKind};
use dpm_handoff::latest::Reader;
use dpm_scene::{LinearTexel, LivePicture, LivePictures};
use std::sync::Arc;

/// Places of a texture: one is shown, one is written, and one may still be read by frames in flight.
pub(super) const PLACES: usize = 3;

/// A texture whose pictures another program makes.
#[derive(Clone, Debug)]
pub struct LiveTexture {
    /// Index among the textures.
    pub(super) texture: usize,
    /// The first texel of each place.
    pub(super) places: Vec<u32>,
    /// Texels of a picture.
    pub(super) len: usize,
    /// The pictures.
    pub(super) pictures: Arc<LivePictures>,
}

/// The live textures of one renderer.
pub(super) struct LiveTextures {
    each: Vec<ReadTexture>,
    /// The texture that is asked first for a piece, so that none waits for ever.
    first: usize,
    /// Most texels that a frame copies.
    most: usize,
    /// Frames so far, and those of them that are known to have ended.
    frames: u64,
    ended: u64,
    /// The texture of the last piece, with its state before.
    before: Option<(usize, TextureState)>,
}

/// One of them.
struct ReadTexture {
    texture: LiveTexture,
    reader: Reader<LivePicture>,
    /// The number of the picture that the renderer has, or is copying.
    number: u64,
    /// The last frame that reads each place.
    read_by: [u64; PLACES],
    state: TextureState,
}

/// What a texture shows.
#[derive(Clone, Copy)]
struct TextureState {
    /// The place that is shown.
    shown: usize,
    /// The place that a picture is copied to, and how many of its texels are there.
    copying: Option<(usize, usize)>,
}

/// The memory of a frame in flight for its piece.
pub(super) struct Piece {
    /// The last frame that was drawn in this memory.
    frame: u64,
    staging: Buffer,
    list: CommandList,
}

impl Piece {
    /// Runs before the frame that it was made for.
    pub(super) fn list(&self) -> &CommandList {
        &self.list
    }
}

impl LiveTextures {
    /// For the live textures of a scene; `None` if it has none. A frame copies at most `most` texels.
    pub(super) fn new(textures: &[LiveTexture], most: usize) -> Option<Self> {
        let longest = textures.iter().map(|texture| texture.len).max()?;
        let each = textures.iter().map(ReadTexture::new).collect();
        Some(Self { each, first: 0, most: most.clamp(1, longest.max(1)), frames: 0, ended: 0, before: None })
    }

    /// Memory for the pieces of a frame in flight.
    ///
    /// # Errors
    /// Out of memory.
    pub(super) fn piece(&self, gpu: &Arc<Gpu>) -> Result<Piece, GpuError> {
        let bytes = self.most * size_of::<LinearTexel>();
        let staging = Buffer::new(gpu, "live pictures", bytes, MemoryKind::Upload)?;
        Ok(Piece { frame: 0, staging, list: CommandList::record(gpu, 0, |_| {})? })
    }

    /// A frame begins in the memory of `piece`, whose last frame has ended. If a new picture waits, its next texels go into `piece`, and
    /// with [`Piece::list`] to `texels`, the scene's. Says whether there are any. Allocates nothing.
    ///
    /// # Errors
    /// The GPU's own.
    pub(super) fn advance(&mut self, piece: &mut Piece, texels: &Buffer) -> Result<bool, GpuError> {
        // A frame ends after the one before it.
        self.ended = self.ended.max(piece.frame);
        self.frames += 1;
        piece.frame = self.frames;
        let count = self.each.len();
        let turn =
            (0..count).map(|k| (self.first + k) % count).find(|turn| self.each[*turn].begin(self.ended));
        self.before = turn.map(|turn| (turn, self.each[turn].state));
        if let Some(turn) = turn {
            self.first = (turn + 1) % count;
            let (next, at) = self.each[turn].next(self.most);
            let bytes: &[u8] = bytemuck::cast_slice(next);
            piece.staging.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
            let (len, at) = (bytes.len(), at * size_of::<LinearTexel>());
            piece.list.record_again(|r| {
                r.copy_to(&piece.staging, texels, len, at);
                r.barrier();
            })?;
            self.each[turn].copied(len / size_of::<LinearTexel>());
        }
        for followed in &mut self.each {
            followed.read_by[followed.state.shown] = self.frames;
        }
        Ok(turn.is_some())
    }

    /// The frame did not run, and its piece was not copied.
    pub(super) fn take_back(&mut self) {
        if let Some((turn, state)) = self.before.take() {
            self.each[turn].state = state;
        }
    }

    /// For each live texture its number among all, and the first texel of what the frame shows.
    pub(super) fn shown(&self) -> impl Iterator<Item = (usize, u32)> + '_ {
        self.each
            .iter()
            .map(|followed| (followed.texture.texture, followed.texture.places[followed.state.shown]))
    }
}

impl ReadTexture {
    fn new(texture: &LiveTexture) -> Self {
        let reader = texture.pictures.follow();
        let state = TextureState { shown: 0, copying: None };
        Self { texture: texture.clone(), reader, number: 0, read_by: [0; PLACES], state }
    }

    /// Whether there are texels to be copied: of a picture that has begun, or of a new one if a place is free. `ended`: the last frame
    /// that is known to have ended.
    fn begin(&mut self, ended: u64) -> bool {
        if self.state.copying.is_some() {
            return true;
        }
        let is_free = |place: &usize| *place != self.state.shown && self.read_by[*place] <= ended;
        let Some(place) = (0..PLACES).find(is_free) else { return false };
        let newest = self.reader.latest().0.number;
        if newest == self.number {
            return false;
        }
        self.number = newest;
        self.state.copying = Some((place, 0));
        true
    }

    /// The next texels, at most `most`, and the first one's number among all texels of the scene. Empty if nothing has begun.
    fn next(&self, most: usize) -> (&[LinearTexel], usize) {
        let (place, done) = self.state.copying.unwrap_or((self.state.shown, self.texture.len));
        let end = (done + most).min(self.texture.len);
        (&self.reader.held().texels[done..end], self.texture.places[place] as usize + done)
    }

    /// So many texels more are copied; with the last ones the picture is shown.
    fn copied(&mut self, texels: usize) {
        let Some((place, done)) = self.state.copying else { return };
        self.state = if done + texels < self.texture.len {
            TextureState { copying: Some((place, done + texels)), ..self.state }
        } else {
            TextureState { shown: place, copying: None }
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::{BTreeSet, VecDeque};

    const LEN: usize = 10;

    fn followed(pictures: &Arc<LivePictures>) -> ReadTexture {
        let places = (0..PLACES as u32).map(|k| 100 + k * LEN as u32).collect();
        ReadTexture::new(&LiveTexture { texture: 0, places, len: LEN, pictures: pictures.clone() })
    }

    fn picture(value: u8) -> Vec<[u8; 4]> {
        vec![[value; 4]; LEN]
    }

    /// Copies and shows as a renderer does whose frames end `in_flight` frames later. In every frame what is shown is one picture, no
    /// frame in flight reads the place that is written, and pictures follow each other in their order.
    #[test]
    fn a_frame_shows_one_picture_and_no_place_is_written_while_it_is_read() {
        for (in_flight, most) in [(1u64, 3), (2, 10), (3, 4), (4, 1), (6, 10)] {
            let pictures = Arc::new(LivePictures::new([LEN as u32, 1]));
            let mut followed = followed(&pictures);
            let mut memory = vec![[0; 2]; 200];
            let (mut in_order, mut last) = (VecDeque::<(u64, usize)>::new(), 0);
            let mut seen = BTreeSet::new();
            for frame in 1..=400u64 {
                if frame % 7 == 0 {
                    pictures.show(&picture((frame / 7) as u8));
                }
                let ended = frame.saturating_sub(in_flight);
                in_order.retain(|(of, _)| *of > ended);
                if followed.begin(ended) {
                    let (texels, at) = followed.next(most);
                    let count = texels.len();
                    assert!((1..=most).contains(&count));
                    for (_, read) in &in_order {
                        assert!(
                            at + count <= *read || *read + LEN <= at,
                            "frame {frame} writes what is read"
                        );
                    }
                    memory[at..at + count].copy_from_slice(texels);
                    followed.copied(count);
                }
                followed.read_by[followed.state.shown] = frame;
                let first = followed.texture.places[followed.state.shown] as usize;
                let shown = memory[first];
                assert!(memory[first..first + LEN].iter().all(|texel| *texel == shown), "torn");
                assert!(shown[0] & 0xffff >= last, "an older picture came back");
                last = shown[0] & 0xffff;
                seen.insert(last);
                in_order.push_back((frame, first));
            }
            // Each picture waits for 7 frames; where its copy takes fewer, every one is shown.
            let expected = if LEN.div_ceil(most) + 2 < 7 { 57 } else { 30 };
            assert!(seen.len() >= expected, "{in_flight} in flight, {most} a frame: {} pictures", seen.len());
        }
    }

    /// A renderer that is made when pictures have been shown begins with the newest of them.
    #[test]
    fn a_new_renderer_copies_what_is_shown_already() {
        let pictures = Arc::new(LivePictures::new([LEN as u32, 1]));
        assert!(!followed(&pictures).begin(0), "nothing was shown");
        pictures.show(&picture(255));
        let mut late = followed(&pictures);
        assert!(late.begin(0));
        assert_eq!(late.next(100).0, vec![[u32::MAX; 2]; LEN]);
    }
}
