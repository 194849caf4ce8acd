//! The state of the light in one of six words, decided from mirrors that were lit in the last second. This is the only
//! place that decides it; the page, metrics, progress lines, systemd's status and the report print it.

use super::monitor::ProjectorHealth;
use crate::order::Order;
use dpm_device::link::LimitReached;

/// What light there is, or why there is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LightState {
    /// Mirrors were lit in the last second, and every body had light.
    Lit {
        /// The picture is held by FREEZE.
        is_held: bool,
    },
    /// Mirrors were lit in the last second, and a tracked body had no light.
    PartlyLit {
        /// The picture is held by FREEZE.
        is_held: bool,
    },
    /// No mirror was lit, because an operator has ordered so.
    DarkByOrder(Order),
    /// No mirror was lit, for this reason.
    Dark(Darkness),
    /// The projector is armed, and no frame was lit.
    Stalled(Stall),
    /// The projector has not been armed since the run began; this is what it does instead.
    NeverArmed(ProjectorHealth),
}

/// Why no mirror is lit although nobody has ordered so.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Darkness {
    /// The projector's state: gone, faulted, resting, or held dark by the interlock.
    Projector(ProjectorHealth),
    /// Frames are lit, and all of them is dark because a tracked head is lost.
    HeadLost,
    /// Frames are lit, and every tracked body is dark in them.
    Bodies,
    /// Frames are lit, and their pictures are black although no body is lost.
    Pictures,
    /// The run is over.
    Over,
}

/// Why no frame is lit although the projector is armed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stall {
    /// The stages are being restarted.
    Restarts,
    /// No frame was sent.
    NothingSent,
    /// Frames were sent, and the projector lit none.
    NothingLit,
    /// The thread of the link gets no time or hangs.
    LinkSilent,
}

/// What is known of the light, from the projector's reports and the frames that they name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Evidence {
    /// The projector, as the link knows it.
    pub projector: ProjectorHealth,
    /// The order that stands.
    pub standing: Option<Order>,
    /// What stands is the demand of `safety.start` for an ARM, and nobody's order.
    pub awaits_first_arm: bool,
    /// The projector was armed in this run.
    pub was_armed: bool,
    /// The projector has reported a frame with lit mirrors within the last second, and has not reported darkness since.
    pub mirrors_lit: bool,
    /// The projector has lit a frame for the first time within the last second, whatever it shows.
    pub frames_lit: bool,
    /// A frame was sent within the last second.
    pub frames_sent: bool,
    /// A frame that is dark for a lost head was lit within the last second.
    pub head_lost: bool,
    /// A tracked body had no light for the last second.
    pub some_body_dark: bool,
    /// The stages are being restarted.
    pub restarts: bool,
    /// The link's thread has done nothing for a second.
    pub link_silent: bool,
    /// The run has ended its light.
    pub is_over: bool,
}

impl LightState {
    /// Every word, in the order of [`LightState::index`].
    pub const WORDS: [&'static str; 6] =
        ["LIT", "PARTLY LIT", "DARK BY ORDER", "DARK", "STALLED", "NEVER ARMED"];

    /// Decides.
    pub fn of(e: &Evidence) -> Self {
        let is_held = e.projector == ProjectorHealth::Frozen;
        if e.mirrors_lit && !e.link_silent && !e.is_over {
            return if e.some_body_dark { Self::PartlyLit { is_held } } else { Self::Lit { is_held } };
        }
        match (e.standing, e.projector) {
            _ if e.is_over => Self::Dark(Darkness::Over),
            (Some(Order::Black), health) if e.awaits_first_arm && !e.was_armed => Self::NeverArmed(health),
            (Some(order), _) if order != Order::Arm => Self::DarkByOrder(order),
            _ if e.link_silent => Self::Stalled(Stall::LinkSilent),
            (_, health) if !e.was_armed => Self::NeverArmed(health),
            (_, ProjectorHealth::Up) if e.restarts => Self::Stalled(Stall::Restarts),
            (_, ProjectorHealth::Up) if e.frames_lit && e.head_lost => Self::Dark(Darkness::HeadLost),
            (_, ProjectorHealth::Up) if e.frames_lit && e.some_body_dark => Self::Dark(Darkness::Bodies),
            (_, ProjectorHealth::Up) if e.frames_lit => Self::Dark(Darkness::Pictures),
            (_, ProjectorHealth::Up) if e.frames_sent => Self::Stalled(Stall::NothingLit),
            (_, ProjectorHealth::Up) => Self::Stalled(Stall::NothingSent),
            (_, ProjectorHealth::Stopped) => Self::Dark(Darkness::Over),
            (_, health) => Self::Dark(Darkness::Projector(health)),
        }
    }

    /// Its place in [`LightState::WORDS`].
    pub const fn index(self) -> usize {
        match self {
            Self::Lit { .. } => 0,
            Self::PartlyLit { .. } => 1,
            Self::DarkByOrder(_) => 2,
            Self::Dark(_) => 3,
            Self::Stalled(_) => 4,
            Self::NeverArmed(_) => 5,
        }
    }

    /// The word.
    pub const fn word(self) -> &'static str {
        Self::WORDS[self.index()]
    }

    /// The word as programs write it: small letters, and `_` for a space.
    pub fn name_of(word: &str) -> String {
        word.to_ascii_lowercase().replace(' ', "_")
    }

    /// Mirrors are lit.
    pub const fn is_lit(self) -> bool {
        matches!(self, Self::Lit { .. } | Self::PartlyLit { .. })
    }

    /// The reason and the remedy; `None` where the word and the bodies say everything.
    pub fn reason(self) -> Option<String> {
        let reason = match self {
            Self::Lit { is_held: false } | Self::PartlyLit { is_held: false } => return None,
            Self::Lit { is_held: true } | Self::PartlyLit { is_held: true } => {
                "FREEZE holds the picture; `dpm arm` lets it move again".into()
            }
            Self::DarkByOrder(Order::Freeze) => {
                "FREEZE stands, and nothing was lit that it could hold; `dpm arm` shows the picture".into()
            }
            Self::DarkByOrder(order) => {
                format!("{} stands; `dpm arm` shows the picture again", order.word().to_uppercase())
            }
            Self::Dark(Darkness::Projector(health)) => health.reason(),
            Self::Dark(Darkness::HeadLost) => {
                "a tracked head is lost, so nobody can say where eyes are; light comes back when the tracker sees it".into()
            }
            Self::Dark(Darkness::Bodies) => return None,
            Self::Dark(Darkness::Pictures) => {
                "the pictures are black: no body is where the projector's light can fall, or nothing lights the scene"
                    .into()
            }
            Self::Dark(Darkness::Over) => "the run is over".into(),
            Self::Stalled(Stall::Restarts) => "the stages of the rig are being restarted".into(),
            Self::Stalled(Stall::NothingSent) => {
                "the projector is armed, and no frame was sent for a second: a stage or the GPU takes too long".into()
            }
            Self::Stalled(Stall::NothingLit) => {
                "frames are sent, and the projector has lit none for a second: is the cable whole and fast enough? \
                 `dpm link-test` measures it"
                    .into()
            }
            Self::Stalled(Stall::LinkSilent) => {
                "the thread of the link gets no time; the projector's watchdog ends the light".into()
            }
            Self::NeverArmed(ProjectorHealth::Black) => "the start is by hand (safety.start); `dpm arm` lights".into(),
            Self::NeverArmed(health) => health.reason(),
        };
        Some(reason)
    }
}

impl ProjectorHealth {
    /// Why it is dark, without the word for it.
    fn reason(self) -> String {
        match self {
            Self::Connecting => "the projector is being connected".into(),
            Self::Up => "the projector is not armed yet".into(),
            Self::Lost => "the projector is lost; plug it in again and the run goes on".into(),
            Self::Resting(LimitReached::Mean | LimitReached::FullWhite)
            | Self::RestingAfterFlashes
            | Self::Faulted(_)
            | Self::InterlockOpen => {
                let told = self.to_string();
                let reason =
                    told.strip_prefix("dark, ").or_else(|| told.strip_prefix("dark ")).unwrap_or(&told);
                reason.to_owned()
            }
            Self::Black | Self::Frozen | Self::Stopped => self.to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::link::faults;
    use LightState as L;
    use ProjectorHealth as H;

    /// An armed projector in whose frames mirrors are lit.
    const LIT: Evidence = Evidence {
        projector: H::Up,
        standing: None,
        awaits_first_arm: false,
        was_armed: true,
        mirrors_lit: true,
        frames_lit: true,
        frames_sent: true,
        head_lost: false,
        some_body_dark: false,
        restarts: false,
        link_silent: false,
        is_over: false,
    };
    /// The same without light.
    const UNLIT: Evidence = Evidence { mirrors_lit: false, ..LIT };
    /// The same without frames.
    const IDLE: Evidence = Evidence { frames_lit: false, ..UNLIT };

    #[test]
    fn every_situation_has_its_word() {
        let table = [
            (LIT, L::Lit { is_held: false }),
            (Evidence { some_body_dark: true, ..LIT }, L::PartlyLit { is_held: false }),
            (
                Evidence { projector: H::Frozen, standing: Some(Order::Freeze), ..LIT },
                L::Lit { is_held: true },
            ),
            // What is lit is called lit, whatever was ordered and whatever the link thinks.
            (Evidence { standing: Some(Order::Black), ..LIT }, L::Lit { is_held: false }),
            (Evidence { projector: H::Lost, ..LIT }, L::Lit { is_held: false }),
            (Evidence { standing: Some(Order::Black), ..UNLIT }, L::DarkByOrder(Order::Black)),
            (
                Evidence { projector: H::Faulted(faults::HOST_SAFE), standing: Some(Order::Safe), ..UNLIT },
                L::DarkByOrder(Order::Safe),
            ),
            (
                Evidence { projector: H::Lost, standing: Some(Order::Safe), was_armed: false, ..UNLIT },
                L::DarkByOrder(Order::Safe),
            ),
            (
                Evidence { projector: H::Frozen, standing: Some(Order::Freeze), ..UNLIT },
                L::DarkByOrder(Order::Freeze),
            ),
            (Evidence { projector: H::Lost, ..UNLIT }, L::Dark(Darkness::Projector(H::Lost))),
            (
                Evidence { projector: H::InterlockOpen, ..UNLIT },
                L::Dark(Darkness::Projector(H::InterlockOpen)),
            ),
            (
                Evidence { projector: H::Resting(LimitReached::Mean), ..UNLIT },
                L::Dark(Darkness::Projector(H::Resting(LimitReached::Mean))),
            ),
            (
                Evidence { projector: H::Faulted(faults::LAMP), ..UNLIT },
                L::Dark(Darkness::Projector(H::Faulted(faults::LAMP))),
            ),
            // The tracker is silent: frames are lit, and they are black.
            (Evidence { some_body_dark: true, ..UNLIT }, L::Dark(Darkness::Bodies)),
            (UNLIT, L::Dark(Darkness::Pictures)),
            (Evidence { head_lost: true, some_body_dark: true, ..UNLIT }, L::Dark(Darkness::HeadLost)),
            (IDLE, L::Stalled(Stall::NothingLit)),
            (Evidence { frames_sent: false, ..IDLE }, L::Stalled(Stall::NothingSent)),
            (Evidence { restarts: true, ..IDLE }, L::Stalled(Stall::Restarts)),
            (Evidence { link_silent: true, ..LIT }, L::Stalled(Stall::LinkSilent)),
            (Evidence { projector: H::Connecting, was_armed: false, ..IDLE }, L::NeverArmed(H::Connecting)),
            (
                Evidence { projector: H::InterlockOpen, was_armed: false, ..IDLE },
                L::NeverArmed(H::InterlockOpen),
            ),
            (
                Evidence {
                    projector: H::Black,
                    standing: Some(Order::Black),
                    awaits_first_arm: true,
                    was_armed: false,
                    ..IDLE
                },
                L::NeverArmed(H::Black),
            ),
            (
                Evidence { projector: H::Black, standing: Some(Order::Black), was_armed: false, ..IDLE },
                L::DarkByOrder(Order::Black),
            ),
            (Evidence { is_over: true, ..LIT }, L::Dark(Darkness::Over)),
            (Evidence { projector: H::Stopped, ..UNLIT }, L::Dark(Darkness::Over)),
        ];
        for (evidence, state) in table {
            assert_eq!(L::of(&evidence), state, "{evidence:?}");
        }
    }

    /// Whatever else is true: no word says light where no mirror is lit, and nothing but the end of the run or a link
    /// that nobody hears from hides lit mirrors.
    #[test]
    fn the_word_says_light_exactly_where_mirrors_are_lit() {
        let healths = [H::Connecting, H::Up, H::Lost, H::Faulted(1), H::Black, H::Frozen, H::InterlockOpen];
        let orders = [None, Some(Order::Black), Some(Order::Freeze), Some(Order::Safe)];
        for bits in 0..1u32 << 10 {
            let bit = |k: u32| bits >> k & 1 == 1;
            for projector in healths {
                for standing in orders {
                    let e = Evidence {
                        projector,
                        standing,
                        awaits_first_arm: bit(0),
                        was_armed: bit(1),
                        mirrors_lit: bit(2),
                        frames_lit: bit(3),
                        frames_sent: bit(4),
                        some_body_dark: bit(5),
                        restarts: bit(6),
                        link_silent: bit(7),
                        is_over: bit(8),
                        head_lost: bit(9),
                    };
                    let state = L::of(&e);
                    assert_eq!(state.is_lit(), e.mirrors_lit && !e.link_silent && !e.is_over, "{e:?}");
                    assert_eq!(L::WORDS[state.index()], state.word());
                    // Every darkness has a reason: a sentence, or the bodies' own.
                    let is_told = state.reason().is_some_and(|reason| !reason.is_empty());
                    assert!(state.is_lit() || is_told || e.some_body_dark, "{state:?}");
                }
            }
        }
    }

    #[test]
    fn reasons_do_not_repeat_the_word() {
        let dark = |health| L::Dark(Darkness::Projector(health)).reason().unwrap();
        assert!(dark(H::InterlockOpen).starts_with("by safety.interlock"), "{}", dark(H::InterlockOpen));
        assert!(dark(H::Faulted(faults::LAMP)).starts_with("latched faults: lamp"));
        assert!(dark(H::Resting(LimitReached::Mean)).starts_with("the mean light reached"));
        assert_eq!(L::name_of("DARK BY ORDER"), "dark_by_order");
    }
}
