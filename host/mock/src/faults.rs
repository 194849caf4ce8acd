//! Parses fault plans: the one vocabulary of faults for every mock and every command line of this crate.
//!
//! A plan is a comma-separated list of `kind[=amount][@start[+length][/period]]`:
//!
//! ```text
//! loss=0.01                      each packet is lost with probability 0.01
//! dropout@1.5s+20ms              nothing for 20 ms, from 1.5 s after the start
//! invalid@1s+6ms/500ms           6 ms of "not tracked", again every 500 ms
//! jump=3@1.5s                    the one sample at or after 1.5 s is 3 m off
//! slow=2ms,duplicate=0.1         2 ms more latency throughout, each packet twice with probability 0.1
//! ```
//!
//! Durations need a unit (`ns`, `us`, `ms`, `s`). Without `@` a fault lasts for the whole run. With `@start` alone it
//! strikes once, on the first item at or after `start`. The choice of items for a probability depends only on the seed,
//! the kind and the item's number, so adding one fault never moves another.

use core::fmt;
use core::str::FromStr;
use dpm_device::rng::Draws;

/// Kinds of faults. The text form is the variant's name in lower case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FaultKind {
    /// An item (sample, packet, datagram) vanishes. Amount: probability.
    Loss,
    /// One byte of an item is changed. Amount: probability.
    Corrupt,
    /// An item is cut short. Amount: probability.
    Truncate,
    /// An item arrives twice. Amount: probability.
    Duplicate,
    /// An item is overtaken by its successor. Amount: probability.
    Reorder,
    /// A number in the item becomes NaN, infinite or absurdly large. Amount: probability.
    Nan,
    /// The quaternion's norm becomes 0, 0.5 or 1e-20. Amount: probability.
    Norm,
    /// The quaternion changes sign (the same rotation; the output must not change). Amount: probability.
    Flip,
    /// The tracker reports that it does not see the body. Amount: probability, 1 if none is given.
    Invalid,
    /// Nothing is captured or sent. Needs a window.
    Dropout,
    /// The same pose repeats with new sequence numbers. Needs a window.
    Stuck,
    /// The pose is off. Amount: metres. Needs a start.
    Jump,
    /// Nothing arrives until the window ends; then everything that waited arrives at once. Needs a window.
    Stall,
    /// Everything arrives later. Amount: duration.
    Slow,
    /// The device is gone and comes back when the window ends. Needs a window.
    Unplug,
    /// The device restarts: counters at 0, state lost. Needs a start.
    Reset,
    /// The tracker does not see one of the bodies. Amount: which, from 1 on.
    Unseen,
    /// The first two bodies have each other's labels. Needs a window.
    Exchange,
}

/// Meaning of a kind's amount.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Amount {
    Probability,
    Metres,
    Duration,
    Body,
    None,
}

/// What a kind requires after `@`.
#[derive(Clone, Copy, PartialEq, Eq)]
enum When {
    Any,
    Start,
    Window,
}

impl FaultKind {
    /// Every kind, in the order of the documentation.
    pub const ALL: [Self; 18] = [
        Self::Loss,
        Self::Corrupt,
        Self::Truncate,
        Self::Duplicate,
        Self::Reorder,
        Self::Nan,
        Self::Norm,
        Self::Flip,
        Self::Invalid,
        Self::Dropout,
        Self::Stuck,
        Self::Jump,
        Self::Stall,
        Self::Slow,
        Self::Unplug,
        Self::Reset,
        Self::Unseen,
        Self::Exchange,
    ];

    /// The name of this kind in a plan.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Loss => "loss",
            Self::Corrupt => "corrupt",
            Self::Truncate => "truncate",
            Self::Duplicate => "duplicate",
            Self::Reorder => "reorder",
            Self::Nan => "nan",
            Self::Norm => "norm",
            Self::Flip => "flip",
            Self::Invalid => "invalid",
            Self::Dropout => "dropout",
            Self::Stuck => "stuck",
            Self::Jump => "jump",
            Self::Stall => "stall",
            Self::Slow => "slow",
            Self::Unplug => "unplug",
            Self::Reset => "reset",
            Self::Unseen => "unseen",
            Self::Exchange => "exchange",
        }
    }

    const fn rules(self) -> (Amount, When) {
        match self {
            Self::Loss | Self::Corrupt | Self::Truncate | Self::Duplicate => (Amount::Probability, When::Any),
            Self::Reorder | Self::Nan | Self::Norm | Self::Flip | Self::Invalid => {
                (Amount::Probability, When::Any)
            }
            Self::Dropout | Self::Stuck | Self::Stall | Self::Unplug | Self::Exchange => {
                (Amount::None, When::Window)
            }
            Self::Jump => (Amount::Metres, When::Start),
            Self::Slow => (Amount::Duration, When::Any),
            Self::Reset => (Amount::None, When::Start),
            Self::Unseen => (Amount::Body, When::Any),
        }
    }
}

/// When a fault is active, nanoseconds after the mock's start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FaultWindow {
    /// First instant.
    pub start_ns: i64,
    /// Length; 0 means the one item at or after the start.
    pub length_ns: i64,
    /// Distance between the starts of repeated windows; 0 means that it does not repeat.
    pub period_ns: i64,
}

impl FaultWindow {
    /// Start of the window that contains `t_ns`, if one does. A window of length 0 contains its start only.
    pub fn containing(&self, t_ns: i64) -> Option<i64> {
        let since = t_ns.checked_sub(self.start_ns).filter(|s| *s >= 0)?;
        let into = if self.period_ns > 0 { since % self.period_ns } else { since };
        (into < self.length_ns.max(1)).then_some(t_ns - into)
    }

    /// True when a window starts in `(after_ns, until_ns]`: this is how items at discrete times detect a window of
    /// length 0.
    pub fn starts_within(&self, after_ns: i64, until_ns: i64) -> bool {
        if until_ns < self.start_ns || until_ns <= after_ns {
            return false;
        }
        let last = if self.period_ns > 0 {
            until_ns - (until_ns - self.start_ns) % self.period_ns
        } else {
            self.start_ns
        };
        last > after_ns
    }
}

/// One entry of a plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fault {
    /// The kind of fault.
    pub kind: FaultKind,
    /// Probability, metres or nanoseconds, according to the kind; 1 for kinds without amount.
    pub amount: f64,
    /// When; `None` means always.
    pub window: Option<FaultWindow>,
}

impl Fault {
    /// True for the item at `t_ns` whose predecessor was at `previous_ns`, before the probability is applied.
    fn is_on(&self, previous_ns: i64, t_ns: i64) -> bool {
        match self.window {
            None => true,
            Some(w) if w.length_ns == 0 => w.starts_within(previous_ns, t_ns),
            Some(w) => w.containing(t_ns).is_some(),
        }
    }
}

/// A checked list of faults. The default is the empty plan, without faults.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct FaultPlan {
    faults: Vec<Fault>,
}

/// Why a text is not a fault plan. Every message quotes the offending piece.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FaultError {
    /// Not a known kind.
    #[error("faults: unknown fault `{0}`; known are loss, corrupt, truncate, duplicate, reorder, nan, norm, flip, invalid, dropout, stuck, jump, stall, slow, unplug, reset, unseen, exchange")]
    UnknownKind(String),
    /// The amount is missing, unreadable or out of range.
    #[error("faults: `{token}`: {rule}")]
    Amount {
        /// The whole entry.
        token: String,
        /// What the amount must be.
        rule: &'static str,
    },
    /// The part after `@` is missing or unreadable.
    #[error("faults: `{token}`: {rule}")]
    Window {
        /// The whole entry.
        token: String,
        /// What is required there.
        rule: &'static str,
    },
    /// This mock does not implement that fault.
    #[error("faults: `{kind}` means nothing to {mock}; it knows {known}")]
    Unsupported {
        /// The fault's name.
        kind: &'static str,
        /// Which mock.
        mock: &'static str,
        /// The faults that it implements.
        known: String,
    },
    /// More entries than [`FaultPlan::MAX_FAULTS`].
    #[error("faults: more than 64 entries")]
    TooMany,
}

impl FaultPlan {
    /// Most entries of a plan.
    pub const MAX_FAULTS: usize = 64;

    /// The entries in the order written.
    pub fn faults(&self) -> &[Fault] {
        &self.faults
    }

    /// True when the plan has no faults.
    pub fn is_empty(&self) -> bool {
        self.faults.is_empty()
    }

    /// An error when the plan has a kind that is not in `known`; `mock` is the name used in the message.
    pub fn check_supported(&self, known: &[FaultKind], mock: &'static str) -> Result<(), FaultError> {
        match self.faults.iter().find(|f| !known.contains(&f.kind)) {
            None => Ok(()),
            Some(f) => {
                let known: Vec<_> = known.iter().map(|k| k.name()).collect();
                Err(FaultError::Unsupported { kind: f.kind.name(), mock, known: known.join(", ") })
            }
        }
    }

    /// Whether a fault of probability kind `kind` strikes item `index` at `t_ns`, its predecessor having been at `previous_ns`.
    pub fn strikes(&self, kind: FaultKind, draws: Draws, index: u64, previous_ns: i64, t_ns: i64) -> bool {
        self.of(kind).any(|(n, f)| {
            let draws = draws.stream(kind as u64).stream(n as u64);
            f.is_on(previous_ns, t_ns) && draws.happens(index, f.amount)
        })
    }

    /// Sum of the amounts of the faults of `kind` that are active for the item at `t_ns` (metres of `jump`, nanoseconds
    /// of `slow`).
    pub fn amount(&self, kind: FaultKind, previous_ns: i64, t_ns: i64) -> f64 {
        self.of(kind).filter(|(_, f)| f.is_on(previous_ns, t_ns)).map(|(_, f)| f.amount).sum()
    }

    /// True if the tracker does not see the body `number`, counted from 1, in the sample at `t_ns`.
    pub(crate) fn hides(&self, number: u16, previous_ns: i64, t_ns: i64) -> bool {
        let number = f64::from(number);
        self.of(FaultKind::Unseen).any(|(_, f)| f.amount == number && f.is_on(previous_ns, t_ns))
    }

    /// True when a window of `kind` contains `t_ns`.
    pub fn is_on(&self, kind: FaultKind, t_ns: i64) -> bool {
        self.window_start(kind, t_ns).is_some()
    }

    /// Start of the earliest-listed window of `kind` that contains `t_ns`.
    pub fn window_start(&self, kind: FaultKind, t_ns: i64) -> Option<i64> {
        self.of(kind).find_map(|(_, f)| f.window?.containing(t_ns))
    }

    /// First instant at or after `t_ns` that no window of `kind` contains: when items that wait for a stall may
    /// continue.
    pub fn end_of(&self, kind: FaultKind, t_ns: i64) -> i64 {
        let mut t = t_ns;
        // Each round passes the end of at least one window for good, or stops; the number of rounds bounds periodic
        // windows that touch.
        for _ in 0..=Self::MAX_FAULTS {
            let leave = self.of(kind).find_map(|(_, f)| {
                let w = f.window?;
                w.containing(t).map(|start| start + w.length_ns.max(1))
            });
            match leave {
                Some(end) => t = end,
                None => break,
            }
        }
        t
    }

    /// True when a window of `kind` starts in `(after_ns, until_ns]` (`reset`, `unplug`).
    pub fn starts_within(&self, kind: FaultKind, after_ns: i64, until_ns: i64) -> bool {
        self.of(kind).any(|(_, f)| f.window.is_some_and(|w| w.starts_within(after_ns, until_ns)))
    }

    /// Latest start of a window of `kind` at or before `t_ns`.
    pub fn last_start(&self, kind: FaultKind, t_ns: i64) -> Option<i64> {
        let starts = self.of(kind).filter_map(|(_, f)| {
            let w = f.window?;
            let since = t_ns.checked_sub(w.start_ns).filter(|s| *s >= 0)?;
            Some(if w.period_ns > 0 { t_ns - since % w.period_ns } else { w.start_ns })
        });
        starts.max()
    }

    fn of(&self, kind: FaultKind) -> impl Iterator<Item = (usize, &Fault)> {
        self.faults.iter().filter(move |f| f.kind == kind).enumerate()
    }
}

impl FromStr for FaultPlan {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let mut faults = Vec::new();
        for token in text.split(',').map(str::trim).filter(|t| !t.is_empty()) {
            if faults.len() == Self::MAX_FAULTS {
                return Err(FaultError::TooMany);
            }
            faults.push(parse_fault(token)?);
        }
        Ok(Self { faults })
    }
}

fn parse_fault(token: &str) -> Result<Fault, FaultError> {
    let (head, when) = match token.split_once('@') {
        Some((head, when)) => (head.trim(), Some(when.trim())),
        None => (token, None),
    };
    let (word, amount) = match head.split_once('=') {
        Some((word, amount)) => (word.trim(), Some(amount.trim())),
        None => (head, None),
    };
    // "drop-out" and "dropout" are both common; the vocabulary ignores hyphens.
    let plain: String = word.chars().filter(|c| *c != '-').collect::<String>().to_ascii_lowercase();
    let kind = FaultKind::ALL.into_iter().find(|k| k.name() == plain);
    let kind = kind.ok_or_else(|| FaultError::UnknownKind(word.to_owned()))?;
    let (meaning, need) = kind.rules();
    let wrong = |rule| FaultError::Amount { token: token.to_owned(), rule };
    let amount = match (meaning, amount) {
        (Amount::None, None) => 1.0,
        (Amount::None, Some(_)) => return Err(wrong("this fault takes no amount")),
        (Amount::Probability, None) if kind == FaultKind::Invalid || when.is_some() => 1.0,
        (Amount::Probability, None) => return Err(wrong("needs a probability, as in `loss=0.01`")),
        (Amount::Probability, Some(a)) => match a.parse::<f64>() {
            Ok(p) if (0.0..=1.0).contains(&p) => p,
            _ => return Err(wrong("the probability must be a number from 0 to 1")),
        },
        (Amount::Metres, a) => match a.and_then(|a| a.parse::<f64>().ok()) {
            Some(m) if m.is_finite() => m,
            _ => return Err(wrong("needs a distance in metres, as in `jump=3@1.5s`")),
        },
        (Amount::Body, a) => match a.and_then(|a| a.parse::<u16>().ok()) {
            Some(number) if number > 0 => f64::from(number),
            _ => return Err(wrong("needs the number of a body, from 1 on, as in `unseen=2@1s+500ms`")),
        },
        (Amount::Duration, a) => match a.and_then(parse_duration) {
            Some(ns) => ns as f64,
            None => return Err(wrong("needs a duration with unit, as in `slow=2ms`")),
        },
    };
    let window = when.map(|w| parse_window(token, w)).transpose()?;
    let missing = |rule| FaultError::Window { token: token.to_owned(), rule };
    match (need, window) {
        (When::Start, None) => Err(missing("needs a start, as in `reset@2s`")),
        (When::Window, None) => Err(missing("needs a start and a length, as in `dropout@2s+20ms`")),
        (When::Window, Some(w)) if w.length_ns == 0 => {
            Err(missing("needs a length too, as in `dropout@2s+20ms`"))
        }
        _ => Ok(Fault { kind, amount, window }),
    }
}

fn parse_window(token: &str, text: &str) -> Result<FaultWindow, FaultError> {
    let wrong = |rule| FaultError::Window { token: token.to_owned(), rule };
    let duration = |t: &str| {
        parse_duration(t.trim())
            .ok_or(wrong("after `@` write start[+length][/period] with units, as in `@1.5s+20ms/1s`"))
    };
    let (text, period_ns) = match text.split_once('/') {
        Some((rest, period)) => (rest, duration(period)?),
        None => (text, 0),
    };
    let (start, length_ns) = match text.split_once('+') {
        Some((start, length)) => (start, duration(length)?),
        None => (text, 0),
    };
    let window = FaultWindow { start_ns: duration(start)?, length_ns, period_ns };
    if text.contains('+') && length_ns == 0 {
        return Err(wrong("the length must be above 0"));
    }
    if period_ns != 0 && period_ns <= length_ns {
        return Err(wrong("the period must be longer than the window"));
    }
    Ok(window)
}

/// Nanoseconds of `1.5s`, `20ms`, `3us`, `7ns`; at most 400 days.
fn parse_duration(text: &str) -> Option<i64> {
    let (number, unit) = [("ns", 1.0), ("us", 1e3), ("ms", 1e6), ("s", 1e9)]
        .into_iter()
        .find_map(|(suffix, unit)| text.strip_suffix(suffix).map(|number| (number, unit)))?;
    let ns = number.trim().parse::<f64>().ok()? * unit;
    (0.0..=400.0 * 86_400e9).contains(&ns).then(|| ns.round() as i64)
}

impl fmt::Display for FaultPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, fault) in self.faults.iter().enumerate() {
            if i > 0 {
                f.write_str(",")?;
            }
            f.write_str(fault.kind.name())?;
            match fault.kind.rules().0 {
                Amount::None => {}
                Amount::Duration => write!(f, "={}ns", fault.amount)?,
                Amount::Probability | Amount::Metres | Amount::Body => write!(f, "={}", fault.amount)?,
            }
            if let Some(w) = fault.window {
                write!(f, "@{}ns", w.start_ns)?;
                if w.length_ns > 0 {
                    write!(f, "+{}ns", w.length_ns)?;
                }
                if w.period_ns > 0 {
                    write!(f, "/{}ns", w.period_ns)?;
                }
            }
        }
        Ok(())
    }
}

impl TryFrom<String> for FaultPlan {
    type Error = FaultError;
    fn try_from(text: String) -> Result<Self, FaultError> {
        text.parse()
    }
}

impl From<FaultPlan> for String {
    fn from(plan: FaultPlan) -> Self {
        plan.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(text: &str) -> FaultPlan {
        text.parse().unwrap()
    }

    #[test]
    fn the_text_form_is_read_and_written_back() {
        let p = plan(" loss=0.01, drop-out@1.5s+20ms/2s ,jump=3@1.5s, slow=2ms,invalid,Reset@3s");
        assert_eq!(p.faults().len(), 6);
        assert_eq!(p.faults()[0], Fault { kind: FaultKind::Loss, amount: 0.01, window: None });
        let w = FaultWindow { start_ns: 1_500_000_000, length_ns: 20_000_000, period_ns: 2_000_000_000 };
        assert_eq!(p.faults()[1].window, Some(w));
        assert_eq!(p.faults()[3].amount, 2e6);
        assert_eq!(p.faults()[4].amount, 1.0);
        assert_eq!(plan(&p.to_string()), p);
        assert!(plan("").is_empty() && plan(" , ").is_empty());
    }

    #[test]
    fn errors_name_the_token() {
        for text in [
            "los=0.1",
            "loss",
            "loss=1.5",
            "loss=x",
            "loss=nan",
            "jump=3",
            "jump@1s",
            "jump=inf@1s",
            "dropout",
            "dropout=1@1s+1s",
            "dropout@1s",
            "stuck@5+1ms",
            "dropout@1s+0ms",
            "slow=2",
            "slow=-2ms",
            "invalid@1s+2s/1s",
            "reset",
            "loss=0.1@x",
            "loss=0.1@1e30s",
        ] {
            let error = format!("loss=0,{text}").parse::<FaultPlan>().unwrap_err().to_string();
            let word = text.split('=').next().unwrap();
            assert!(error.contains(text) || error.contains(word), "{text}: {error}");
        }
        let many = "loss=0,".repeat(65);
        assert_eq!(many.parse::<FaultPlan>(), Err(FaultError::TooMany));
        let error =
            plan("unplug@1s+1s").check_supported(&[FaultKind::Loss], "the kettle").unwrap_err().to_string();
        assert!(
            error.contains("unplug") && error.contains("the kettle") && error.contains("loss"),
            "{error}"
        );
    }

    #[test]
    fn windows_open_and_close_to_the_nanosecond() {
        let p = plan("dropout@10ns+5ns/20ns,dropout@100ns+7ns");
        let on: Vec<i64> = (0..40).filter(|t| p.is_on(FaultKind::Dropout, *t)).collect();
        assert_eq!(on, [10, 11, 12, 13, 14, 30, 31, 32, 33, 34]);
        assert_eq!(p.end_of(FaultKind::Dropout, 12), 15);
        assert_eq!(p.end_of(FaultKind::Dropout, 15), 15);
        assert_eq!(p.window_start(FaultKind::Dropout, 33), Some(30));
        assert_eq!(p.last_start(FaultKind::Dropout, 29), Some(10));
        assert_eq!(p.last_start(FaultKind::Dropout, 9), None);
        let p = plan("jump=2@10ns,jump=1@12ns+10ns");
        // Items every 8 ns: the one at 16 is the first at or after 10.
        let amounts: Vec<f64> = (0..4).map(|k| p.amount(FaultKind::Jump, 8 * k - 8, 8 * k)).collect();
        assert_eq!(amounts, [0.0, 0.0, 3.0, 0.0]);
        let p = plan("reset@10ns/20ns");
        assert!(!p.starts_within(FaultKind::Reset, 10, 29) && p.starts_within(FaultKind::Reset, 29, 30));
    }

    #[test]
    fn probabilities_are_kept_and_faults_do_not_move_each_other() {
        let n = 100_000;
        let draws = Draws::new(5);
        let alone = plan("loss=0.02");
        let mixed = plan("duplicate=0.5,loss=0.02");
        let hits: Vec<u64> = (0..n).filter(|i| alone.strikes(FaultKind::Loss, draws, *i, -1, 0)).collect();
        let sigma = (0.02f64 * 0.98 * n as f64).sqrt();
        assert!((hits.len() as f64 - 0.02 * n as f64).abs() < 5.0 * sigma, "{}", hits.len());
        let again: Vec<u64> = (0..n).filter(|i| mixed.strikes(FaultKind::Loss, draws, *i, -1, 0)).collect();
        assert_eq!(hits, again);
    }
}
