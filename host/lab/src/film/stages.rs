//! What the film shows when.

/// What a picture of the film shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FilmStage {
    /// Three words.
    pub caption: &'static str,
    /// Light of the room, 1 where it is bright.
    pub room: f32,
    /// Share of the projector's light that is shown.
    pub projector: f32,
    /// Single planes are shown in place of their sum.
    pub shows_planes: bool,
}

/// Begin of the stages, shares of the film, and their captions.
const CAPTIONS: [(f64, &str); 4] = [
    (0.0, "BARE MOVING OBJECTS"),
    (0.2, "PROJECTOR SWITCHED ON"),
    (0.42, "LIGHT FOLLOWS MOTION"),
    (0.7, "SINGLE PLANES, SLOWED"),
];

/// The room is darkened, and the projector brightened, from here to there.
const FADE: [f64; 2] = [0.2, 0.32];

/// The room's light while the projector shines.
const DIM: f32 = 0.1;

/// The instants of the strip: one of each stage, shares of the film.
pub(super) const INSTANTS: [f64; 4] = [0.1, 0.34, 0.55, 0.88];

impl FilmStage {
    /// At `share` of the film, 0 to 1.
    pub(super) fn at(share: f64) -> Self {
        let index = CAPTIONS.iter().rposition(|(begin, _)| share >= *begin).unwrap_or(0);
        let x = ((share - FADE[0]) / (FADE[1] - FADE[0])).clamp(0.0, 1.0);
        let faded = (x * x * (3.0 - 2.0 * x)) as f32;
        Self {
            caption: CAPTIONS[index].1,
            room: 1.0 - (1.0 - DIM) * faded,
            projector: faded,
            shows_planes: index == 3,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_caption_has_three_words_and_its_instant_in_the_strip() {
        for (caption, instant) in CAPTIONS.iter().zip(INSTANTS) {
            assert_eq!(caption.1.split_whitespace().count(), 3, "{}", caption.1);
            assert_eq!(FilmStage::at(instant).caption, caption.1);
        }
    }

    #[test]
    fn the_projector_is_off_in_the_first_stage_and_fully_on_in_the_third() {
        assert_eq!((FilmStage::at(0.0).projector, FilmStage::at(0.0).room), (0.0, 1.0));
        let third = FilmStage::at(CAPTIONS[2].0);
        assert_eq!(third.projector, 1.0);
        assert!((third.room - DIM).abs() < 1e-6);
        // The light only grows.
        let shares = (0..=100).map(|i| FilmStage::at(f64::from(i) / 100.0).projector);
        assert!(shares.clone().zip(shares.skip(1)).all(|(a, b)| b >= a));
    }
}
