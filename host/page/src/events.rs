//! The rig's events for one viewer, as server-sent events: the state and the places of the room five times a second, figures when there are new
//! ones, notes, and pictures. What a slow viewer has no room for is never made.

use crate::room;
use crate::shared::Viewer;
use crate::site::Site;
use crate::state::RigState;
use base64::prelude::{Engine, BASE64_STANDARD};
use dpm_rig::telemetry::live::LiveSnapshot;
use hyper::body::Bytes;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::time::{sleep, Instant, Sleep};

/// The shortest time between two events: ten pictures a second.
const TICK: Duration = Duration::from_millis(100);
/// The state is sent with every so many ticks.
const STATE_EVERY: u32 = 2;

/// What one viewer still has to be told.
pub(crate) struct Events {
    viewer: Viewer,
    next: Pin<Box<Sleep>>,
    ticks: u32,
    notes_from: u64,
    figures: Option<Arc<LiveSnapshot>>,
    /// Of the parameters that were told last.
    parameters: Option<[u64; 3]>,
    pictures: u64,
    /// For whom events are proven, and how many there were.
    proven_for: Option<(Arc<Site>, String)>,
    count: u64,
}

impl Events {
    /// With a number that the viewer has drawn, its events are proven by the rig's secret.
    pub(crate) fn new(viewer: Viewer, proven_for: Option<(Arc<Site>, String)>) -> Self {
        Self {
            viewer,
            next: Box::pin(sleep(Duration::ZERO)),
            ticks: 0,
            notes_from: 0,
            figures: None,
            parameters: None,
            pictures: 0,
            proven_for,
            count: 0,
        }
    }

    /// The next events; pending until there are any.
    pub(crate) fn poll_next(&mut self, cx: &mut Context<'_>) -> Poll<Bytes> {
        loop {
            if self.next.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
            self.next.as_mut().reset(Instant::now() + TICK);
            let text = self.due();
            if !text.is_empty() {
                return Poll::Ready(text.into());
            }
        }
    }

    fn due(&mut self) -> String {
        let shared = self.viewer.0.clone();
        shared.monitor.live().look();
        let mut text = String::new();
        if self.ticks == 0 {
            // A browser that lost the rig asks again every half second.
            text += "retry: 500\n\n";
        }
        if self.ticks.is_multiple_of(STATE_EVERY) {
            let state = RigState::of(&shared);
            self.event(&mut text, "state", &state.now);
            let is_new = state.figures.as_ref().map(Arc::as_ptr) != self.figures.as_ref().map(Arc::as_ptr);
            if is_new || self.ticks == 0 {
                self.event(&mut text, "figures", &state.to_json().figures);
                self.figures = state.figures;
            }
            if let Some(places) = room::places(&shared) {
                self.event(&mut text, "room", &places);
            }
            let mark = shared.monitor.parameters().mark();
            if mark != self.parameters || self.ticks == 0 {
                self.parameters = mark;
                self.event(&mut text, "parameters", &shared.monitor.parameters().shown());
            }
            let notes = shared.notes.since(self.notes_from);
            if let Some(last) = notes.last() {
                self.notes_from = last.number + 1;
                self.event(&mut text, "notes", &notes);
            }
        }
        self.ticks = self.ticks.wrapping_add(1).max(1);
        shared.pictures.look();
        let pictures = shared.pictures.newest();
        if pictures.number != self.pictures {
            self.pictures = pictures.number;
            let of = |png: &Option<Vec<u8>>| png.as_ref().map(|bytes| BASE64_STANDARD.encode(bytes));
            let told = serde_json::json!({
                "light": of(&pictures.light),
                "viewer": of(&pictures.viewer),
                "told": pictures.told,
                "per_s": pictures.per_s,
            });
            self.event(&mut text, "pictures", &told);
        }
        text
    }

    fn event(&mut self, text: &mut String, name: &str, data: &impl serde::Serialize) {
        // JSON on one line has no line feed inside.
        let Ok(data) = serde_json::to_string(data) else { return };
        for part in ["event: ", name, "\ndata: ", &data, "\n"] {
            *text += part;
        }
        if let Some((site, number)) = &self.proven_for {
            // What a browser hands to the page's script with the event.
            for part in [
                "id: ",
                &site.door.guard.event_proof(number, self.count, name, &data).unwrap_or_default(),
                "\n",
            ] {
                *text += part;
            }
        }
        self.count += 1;
        text.push('\n');
    }
}
