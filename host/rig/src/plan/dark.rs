//! Why no light may fall on a body although its frame is lit.

/// Why a body is dark in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum DarkCause {
    /// The tracker has not reported the body since the run began.
    NeverSeen,
    /// The newest sample of the body was already too old when the frame's poses were taken: the tracker has fallen
    /// silent, or has lost the body.
    Silent,
    /// The tracker reports the body, but the frame's light falls later after the newest sample than
    /// `safety.predict_ms` allows.
    BeyondHorizon,
    /// The tracker has lost a head that is guarded, so nothing is lit (`[safety.eyes]`).
    HeadLost,
}

impl DarkCause {
    /// All causes, in the order of their counters.
    pub const ALL: [Self; 4] = [Self::NeverSeen, Self::Silent, Self::BeyondHorizon, Self::HeadLost];

    /// The name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::NeverSeen => "never_seen",
            Self::Silent => "silent",
            Self::BeyondHorizon => "beyond_horizon",
            Self::HeadLost => "head_lost",
        }
    }

    /// What the operator reads after the name of the body.
    pub const fn told(self) -> &'static str {
        match self {
            Self::NeverSeen => "the tracker has never seen it",
            Self::Silent => "the tracker has not reported it for longer than safety.predict_ms",
            Self::BeyondHorizon => {
                "the light falls later after its newest sample than safety.predict_ms allows (raise safety.predict_ms, or \
                 reduce the latency from the tracker to the light)"
            }
            Self::HeadLost => {
                "the tracker has lost a head that is guarded (bring it into view; [safety.eyes] says how long it may be lost)"
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_have_their_own_counters_and_names() {
        for (i, cause) in DarkCause::ALL.into_iter().enumerate() {
            assert_eq!(cause as usize, i);
            assert_eq!(DarkCause::ALL.iter().filter(|c| c.name() == cause.name()).count(), 1);
        }
    }
}
