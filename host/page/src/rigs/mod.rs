//! Several rigs on one page: each is asked for its state once a second while somebody looks, and what it told last is
//! kept.
//!
//! A rig is asked at its own page, as a browser would ask. Each has a task of its own, so one that hangs delays no
//! other. An overview gives no orders.

mod address;
mod ask;
mod told;

pub use address::{BadAddress, RigAddress};

use ask::{ask, AskError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use told::{Minute, RigView, StateAnswer};

/// Where an overview listens if nobody says otherwise.
pub const DEFAULT_LISTEN: &str = "127.0.0.1:8940";
/// Most rigs of one overview.
pub const MAX_RIGS: usize = 32;
/// How often a rig is asked.
const EVERY: Duration = Duration::from_secs(1);
/// How long somebody counts as looking after the last request for the rigs' states.
const LOOKED_WITHIN: Duration = Duration::from_secs(5);
/// A rig that has told nothing for so long has no contact.
const HEARD_WITHIN: Duration = Duration::from_secs(3);

/// Why there is no overview of these rigs.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BadRigs {
    /// There is no rig, or more than [`MAX_RIGS`].
    #[error("{0} rigs are named; an overview shows 1 to {MAX_RIGS}")]
    Count(usize),
    /// Two rigs have the same name.
    #[error("two rigs are called {0:?}; give each a name of its own, as in NAME=HOST:PORT")]
    Name(String),
    /// Two rigs have the same address.
    #[error("{0:?} and {1:?} have the same address; name each rig once")]
    Address(String, String),
}

/// The rigs of one overview, and what they told last.
#[derive(Debug)]
pub struct Rigs {
    all: Vec<Arc<NeighbourRig>>,
    /// When somebody looked; `None` before the first time.
    looked: watch::Sender<Option<LastLook>>,
}

/// When somebody looked.
#[derive(Clone, Copy, Debug)]
struct LastLook {
    /// The first time without a pause since.
    since: Instant,
    /// The last time.
    last: Instant,
}

/// One rig.
#[derive(Debug)]
struct NeighbourRig {
    address: RigAddress,
    heard: Mutex<RigNews>,
}

/// What a rig told last, and what went wrong since.
#[derive(Debug, Default)]
struct RigNews {
    minute: Minute,
    told: Option<(Instant, RigView)>,
    /// The newest attempt, if it failed.
    failed: Option<(Instant, AskError)>,
}

/// Whether a rig answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
enum Contact {
    /// Nobody has looked for a while, and the rig is asked only now.
    Asked,
    /// It has told its state within [`HEARD_WITHIN`].
    Yes,
    No,
}

/// A rig as the overview shows it.
#[derive(Debug, serde::Serialize)]
struct RigJson {
    name: String,
    /// Where it is asked.
    address: String,
    /// The port under which a browser opens the rig's page.
    port: u16,
    contact: Contact,
    /// Seconds since it told its state; `None` if it never did.
    heard_s_ago: Option<f64>,
    /// Why there is no contact.
    why: Option<String>,
    told: Option<RigView>,
}

/// All rigs as the overview shows them.
#[derive(Debug, serde::Serialize)]
pub(crate) struct RigsJson {
    rigs: Vec<RigJson>,
}

impl Rigs {
    /// The rigs at these addresses, in this order.
    ///
    /// # Errors
    /// None, more than [`MAX_RIGS`], or two with the same name or address.
    pub fn new(addresses: Vec<RigAddress>) -> Result<Self, BadRigs> {
        if !(1..=MAX_RIGS).contains(&addresses.len()) {
            return Err(BadRigs::Count(addresses.len()));
        }
        for (k, one) in addresses.iter().enumerate() {
            for other in &addresses[..k] {
                if one.address() == other.address() {
                    return Err(BadRigs::Address(other.name().to_owned(), one.name().to_owned()));
                }
                if one.name() == other.name() {
                    return Err(BadRigs::Name(one.name().to_owned()));
                }
            }
        }
        let all =
            addresses.into_iter().map(|address| Arc::new(NeighbourRig { address, heard: Mutex::default() }));
        Ok(Self { all: all.collect(), looked: watch::Sender::new(None) })
    }

    /// Asks the rigs while somebody looks, from now until the runtime ends.
    pub(crate) fn follow(&self) {
        for rig in &self.all {
            tokio::spawn(follow(rig.clone(), self.looked.subscribe()));
        }
    }

    /// Somebody looks: notes that, and returns what is known.
    pub(crate) fn look(&self) -> RigsJson {
        let now = Instant::now();
        let mut since = now;
        self.looked.send_modify(|looked| {
            since = looked.filter(|looked| now - looked.last < LOOKED_WITHIN).map_or(now, |l| l.since);
            *looked = Some(LastLook { since, last: now });
        });
        RigsJson { rigs: self.all.iter().map(|rig| rig.shown(now, since)).collect() }
    }
}

async fn follow(rig: Arc<NeighbourRig>, mut looked: watch::Receiver<Option<LastLook>>) {
    let is_looking = |looked: &Option<LastLook>| looked.is_some_and(|l| l.last.elapsed() < LOOKED_WITHIN);
    while looked.wait_for(is_looking).await.is_ok() {
        let begin = Instant::now();
        rig.note(ask(&rig.address).await);
        tokio::time::sleep_until((begin + EVERY).into()).await;
    }
}

impl NeighbourRig {
    /// Keeps the outcome of an attempt.
    fn note(&self, outcome: Result<StateAnswer, AskError>) {
        let mut heard = self.heard.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        match outcome {
            Ok(answer) => {
                heard.told = Some((now, answer.told(&mut heard.minute)));
                heard.failed = None;
            }
            Err(why) => heard.failed = Some((now, why)),
        }
    }

    /// What is known at `now` for those who look since `since`.
    fn shown(&self, now: Instant, since: Instant) -> RigJson {
        let heard = self.heard.lock().unwrap_or_else(PoisonError::into_inner);
        let ago = heard.told.as_ref().map(|(at, _)| now.saturating_duration_since(*at));
        let failed = heard.failed.as_ref().filter(|(at, _)| *at >= since).map(|(_, why)| why);
        let contact = match ago {
            Some(ago) if ago < HEARD_WITHIN => Contact::Yes,
            _ if failed.is_some() || now - since >= HEARD_WITHIN => Contact::No,
            _ => Contact::Asked,
        };
        let why = || failed.map_or_else(|| AskError::Slow.to_string(), AskError::to_string);
        RigJson {
            name: self.address.name().to_owned(),
            address: self.address.address().to_string(),
            port: self.address.address().port(),
            contact,
            heard_s_ago: ago.map(|ago| (ago.as_secs_f64() * 1e3).round() / 1e3),
            why: (contact == Contact::No).then(why),
            told: heard.told.as_ref().map(|(_, told)| told.clone()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rigs(all: &[&str]) -> Result<Rigs, BadRigs> {
        Rigs::new(all.iter().map(|text| text.parse().unwrap()).collect())
    }

    #[test]
    fn a_rig_is_named_once() {
        assert!(rigs(&["a=127.0.0.1:1", "b=127.0.0.1:2", "127.0.0.1:3"]).is_ok());
        let told = |all: &[&str]| rigs(all).unwrap_err().to_string();
        assert!(told(&["a=127.0.0.1:1", "a=127.0.0.1:2"]).contains("two rigs are called \"a\""));
        assert!(told(&["a=127.0.0.1:1", "b=localhost:1"]).contains("\"a\" and \"b\" have the same address"));
        assert!(told(&[]).contains("0 rigs"));
        let many: Vec<String> = (1..=33).map(|port| format!("127.0.0.1:{port}")).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        assert!(rigs(&many[..32]).is_ok());
        assert!(told(&many).contains("33 rigs are named; an overview shows 1 to 32"));
    }

    #[test]
    fn contact_is_lost_by_silence_and_not_by_nobody_looking() {
        let all = rigs(&["a=127.0.0.1:1"]).unwrap();
        let rig = &all.all[0];
        let (begin, s) = (Instant::now(), Duration::from_secs);
        assert_eq!(rig.shown(begin + s(1), begin).contact, Contact::Asked, "it may still answer");
        let silent = rig.shown(begin + s(3), begin);
        assert!(silent.contact == Contact::No && silent.why.unwrap().contains("no answer"));
        let answer = r#"{"now":{"pid":1,"up_s":1,"light":{"word":"LIT","state":"lit","told":"","is_lit":true},"standing":null,
            "interlock":null,"tracker":null,"is_stopping":false,
            "counts":{"frames_lit":1,"slots":1,"slots_missed":0}},"figures":{}}"#;
        rig.note(Ok(serde_json::from_str(answer).unwrap()));
        assert_eq!(rig.shown(Instant::now() + s(2), begin).contact, Contact::Yes);
        assert_eq!(rig.shown(Instant::now() + s(4), begin).contact, Contact::No);
        // Whoever looks again after a minute is shown what was known, but not that the rig is silent.
        let later = Instant::now() + s(60);
        assert_eq!(rig.shown(later, later).contact, Contact::Asked);
        rig.note(Err(AskError::Refused));
        assert_eq!(rig.shown(Instant::now(), begin).contact, Contact::Yes, "one failure is no silence");
        let lost = rig.shown(Instant::now() + s(4), begin);
        assert!(lost.contact == Contact::No && lost.why.unwrap().contains("nobody listens"));
        assert!(lost.told.is_some(), "what was told last stays");
    }
}
