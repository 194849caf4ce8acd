//! Pictures that another program makes while the scene is shown, on a body whose light follows them.

use super::texels::{LinearTexel, ToLinear};
use dpm_handoff::latest::{latest, Publisher, Reader};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The newest picture of another program. One thread shows pictures here; every renderer follows them with a reader of its own, which
/// neither locks nor waits.
#[derive(Debug)]
pub struct LivePictures {
    size: [u32; 2],
    to_linear: ToLinear,
    shown: Mutex<ShownPictures>,
}

/// What has been shown, and to whom. No frame waits for this lock: a renderer takes it once, before its first frame.
#[derive(Debug)]
struct ShownPictures {
    newest: LivePicture,
    srgb: Vec<[u8; 4]>,
    /// Pictures of the other program so far.
    count: u64,
    followers: Vec<Publisher<LivePicture>>,
}

/// One picture, as shaders read it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LivePicture {
    /// Rises from one to the next; 0: none has been shown.
    pub number: u64,
    /// Rows from top to bottom.
    pub texels: Vec<LinearTexel>,
}

/// What is shown before the first picture: black, opaque.
const BLACK: [u8; 4] = [0, 0, 0, 255];

impl LivePictures {
    /// Black, until a picture of `size` texels (columns, rows) is shown.
    pub fn new(size: [u32; 2]) -> Self {
        let srgb = vec![BLACK; size[0] as usize * size[1] as usize];
        let to_linear = ToLinear::new(true);
        let texels = srgb.iter().map(|texel| to_linear.texel(*texel)).collect();
        let newest = LivePicture { number: 0, texels };
        Self {
            size,
            to_linear,
            shown: Mutex::new(ShownPictures { newest, srgb, count: 0, followers: vec![] }),
        }
    }

    /// Columns and rows of every picture.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Makes a picture the newest: RGBA, sRGB, rows from top to bottom. Its surface is opaque, whatever its alpha says. A picture
    /// of another length is not shown.
    pub fn show(&self, picture: &[[u8; 4]]) {
        let mut shown = self.lock();
        if picture.len() == shown.srgb.len() {
            shown.count += 1;
            self.publish(&mut shown, picture.iter().copied());
        }
    }

    /// Makes black the newest picture: nothing old stays in the light when the other program has ended.
    pub fn show_black(&self) {
        self.publish(&mut self.lock(), std::iter::repeat(BLACK));
    }

    fn publish(&self, shown: &mut ShownPictures, picture: impl Iterator<Item = [u8; 4]>) {
        let ShownPictures { newest, srgb, followers, .. } = shown;
        for ((kept, texel), [r, g, b, _]) in srgb.iter_mut().zip(&mut newest.texels).zip(picture) {
            *kept = [r, g, b, 255];
            *texel = self.to_linear.texel(*kept);
        }
        newest.number += 1;
        // Renderers come and go: when the GPU was lost, and for the pictures that a run leaves.
        followers.retain(Publisher::has_reader);
        for follower in followers {
            follower.publish_with(|picture| picture.clone_from(newest));
        }
    }

    /// How many pictures of the other program have been shown.
    pub fn count(&self) -> u64 {
        self.lock().count
    }

    /// The newest picture: RGBA, sRGB.
    pub fn newest(&self) -> Vec<[u8; 4]> {
        self.lock().srgb.clone()
    }

    /// Follows the pictures from the newest one on, which the reader has at once.
    pub fn follow(&self) -> Reader<LivePicture> {
        let mut shown = self.lock();
        let (publisher, reader) = latest(shown.newest.clone());
        shown.followers.push(publisher);
        reader
    }

    fn lock(&self) -> MutexGuard<'_, ShownPictures> {
        // A picture is whole or not yet shown, so nothing is left half done by a panic.
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn even(value: u8) -> Vec<[u8; 4]> {
        vec![[value, 0, 255, 7]; 6]
    }

    #[test]
    fn every_reader_has_the_newest_picture_whole_and_opaque() {
        let pictures = LivePictures::new([3, 2]);
        let mut early = pictures.follow();
        assert_eq!(early.latest().0, &LivePicture { number: 0, texels: vec![[0, 0xffff_0000]; 6] });
        for value in [1, 128, 255] {
            pictures.show(&even(value));
        }
        let mut late = pictures.follow();
        let whole = LivePicture { number: 3, texels: vec![[0x0000_ffff, 0xffff_ffff]; 6] };
        assert_eq!((early.latest(), late.latest()), ((&whole, true), (&whole, false)));
        assert_eq!((pictures.count(), &pictures.newest()[..]), (3, &[[255, 0, 255, 255]; 6][..]));
        // Of another size: not shown.
        pictures.show(&even(9)[..5]);
        assert_eq!((early.latest(), pictures.count()), ((&whole, false), 3));
        pictures.show_black();
        assert_eq!((late.latest().0.texels[..].to_vec(), pictures.count()), (vec![[0, 0xffff_0000]; 6], 3));
    }

    #[test]
    fn readers_that_are_gone_cost_nothing() {
        let pictures = LivePictures::new([1, 1]);
        let readers: Vec<_> = (0..5).map(|_| pictures.follow()).collect();
        drop(readers);
        let mut last = pictures.follow();
        pictures.show(&[[255; 4]]);
        assert_eq!(pictures.lock().followers.len(), 1);
        assert_eq!(last.latest().0.number, 1);
    }
}
