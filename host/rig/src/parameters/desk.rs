//! The desk where parameters are changed, taken back and saved. It works beside the frame path: planning reads the
//! newest version from a hand-off that neither locks nor waits.

use super::applied::{middles, ParameterVersion};
use super::{told_of, ChangeRefusal, Parameter, Values};
use crate::gaze::at_point;
use crate::rig::Rig;
use dpm_common::keys::source::{SourceNode, Value};
use dpm_handoff::latest::{latest, Publisher, Reader};
use dpm_handoff::path::Lock;
use glam::{DAffine3, DVec3};
use std::collections::VecDeque;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, MutexGuard, OnceLock, PoisonError};

/// Changes that can be taken back; older ones stay.
const MOST_KEPT: usize = 1000;
/// Changes of one parameter that follow each other within this time are taken back together: a slider that is drawn.
const ONE_STEP_NS: u64 = 1_000_000_000;

/// A value of the rig file.
#[derive(Clone, Debug, PartialEq)]
pub enum Setting {
    /// A number.
    Number(f64),
    /// A whole number.
    Whole(i64),
    /// Three numbers.
    Point([f64; 3]),
    /// A word.
    Text(String),
    /// Keys and values on one line.
    Table(Vec<(&'static str, Setting)>),
}

/// What is to be kept for the next run: only what differs from what the files say.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ToKeep {
    /// Keys of the rig file.
    pub keys: Vec<([&'static str; 2], Setting)>,
    /// world-from-projector, for the calibration file.
    pub projector: Option<DAffine3>,
    /// Names of bodies and body-from-mesh, for the calibration file.
    pub bodies: Vec<(String, DAffine3)>,
}

/// Writes files; returns what to tell the operator, or why nothing was written.
pub type Saver = Box<dyn Fn(&Rig, &ToKeep) -> Result<String, String> + Send + Sync>;

struct ParameterHistory {
    rig: Arc<Rig>,
    middles: Vec<DVec3>,
    values: Values,
    /// What the files say.
    saved: Values,
    version: u64,
    before: VecDeque<Values>,
    /// What was changed last, and when.
    last: Option<(Parameter, u64)>,
    to_planning: Publisher<ParameterVersion>,
}

/// Where parameters are changed. It exists from the beginning, and is of use from the first [`ParameterDesk::follow`].
#[derive(Default)]
pub struct ParameterDesk {
    state: Lock<Option<ParameterHistory>>,
    /// The newest version that planning uses, and its first frame.
    used: AtomicU64,
    used_since: AtomicU64,
    saver: OnceLock<Saver>,
    /// Files are being written.
    is_saving: AtomicBool,
    /// The run draws no scene.
    is_closed: AtomicBool,
}

impl fmt::Debug for ParameterDesk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ParameterDesk").field("used", &self.used).finish_non_exhaustive()
    }
}

/// A parameter with its numbers, for those who show it.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ParameterView {
    /// Its name.
    pub name: String,
    /// What it does.
    pub told: &'static str,
    /// Its numbers; none for a gaze that is as the rig file says.
    pub numbers: Vec<f64>,
    /// The same when the run began.
    pub began_with: Vec<f64>,
    /// What each number is.
    pub fields: Vec<super::ParameterField>,
}

/// All parameters at one moment.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct AllShown {
    /// Number of the newest change.
    pub version: u64,
    /// The newest version that planning uses.
    pub used: u64,
    /// There is something to take back.
    pub can_undo: bool,
    /// The values differ from what the files say.
    pub is_unsaved: bool,
    /// Every parameter that has an effect.
    pub all: Vec<ParameterView>,
}

impl ParameterDesk {
    fn state(&self) -> MutexGuard<'_, Option<ParameterHistory>> {
        // Nothing panics while it holds this lock.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The parameters of `rig` for a planning stage that begins. Values that were changed before stay.
    pub(crate) fn follow(&self, rig: &Arc<Rig>) -> Reader<ParameterVersion> {
        let mut place = self.state();
        let (middles, values, version) = match place.as_ref() {
            Some(s) => (s.middles.clone(), s.values.clone(), s.version),
            None => (middles(rig), Values::of(rig), 0),
        };
        let (to_planning, reader) = latest(ParameterVersion::new(version, &values, rig, &middles));
        match place.as_mut() {
            Some(state) => state.to_planning = to_planning,
            None => {
                let (rig, saved) = (rig.clone(), values.clone());
                let (before, last) = (VecDeque::new(), None);
                *place = Some(ParameterHistory {
                    rig,
                    middles,
                    values,
                    saved,
                    version,
                    before,
                    last,
                    to_planning,
                });
            }
        }
        reader
    }

    /// Planning uses `version` from `frame` on. Two writes to memory; the frame path may call it.
    pub(crate) fn uses(&self, version: u64, frame: u64) {
        self.used_since.store(frame, Ordering::Relaxed);
        // Release: whoever sees the version also sees its frame.
        self.used.store(version, Ordering::Release);
    }

    /// The first frame for which planning uses `version` or a newer one; `None` before that.
    pub fn used_since(&self, version: u64) -> Option<u64> {
        let used = self.used.load(Ordering::Acquire);
        (used >= version).then(|| self.used_since.load(Ordering::Relaxed))
    }

    /// Says how values are kept. The first call counts.
    pub fn set_saver(&self, saver: Saver) {
        let _ = self.saver.set(saver);
    }

    /// This run draws no scene: nothing can be changed.
    pub(crate) fn close(&self) {
        self.is_closed.store(true, Ordering::Relaxed);
    }

    /// The state of a run that draws a scene.
    fn open(&self) -> Option<MutexGuard<'_, Option<ParameterHistory>>> {
        let state = self.state();
        (state.is_some() && !self.is_closed.load(Ordering::Relaxed)).then_some(state)
    }

    /// How values are kept; `None` if this run knows no files.
    pub(crate) fn saver(&self) -> Option<&Saver> {
        self.saver.get()
    }

    /// Begins to write files. False while they are being written already.
    pub(crate) fn begin_saving(&self) -> bool {
        !self.is_saving.swap(true, Ordering::AcqRel)
    }

    /// The files are written, or not.
    pub(crate) fn end_saving(&self) {
        self.is_saving.store(false, Ordering::Release);
    }

    /// All values; `None` if this run has none.
    pub fn shown(&self) -> Option<AllShown> {
        let state = self.open()?;
        let s = state.as_ref()?;
        let began = Values::of(&s.rig);
        let one = |p: Parameter| ParameterView {
            name: p.name(&s.rig),
            told: p.told(),
            numbers: s.values.get(p),
            began_with: began.get(p),
            fields: p.fields(&s.rig),
        };
        Some(AllShown {
            version: s.version,
            used: self.used.load(Ordering::Acquire),
            can_undo: !s.before.is_empty(),
            is_unsaved: s.values != s.saved,
            all: Parameter::all_of(&s.rig).into_iter().map(one).collect(),
        })
    }

    /// Where the projector stands by the newest values; `None` if this run has none.
    pub fn projector(&self) -> Option<DAffine3> {
        let place = self.state();
        let s = place.as_ref()?;
        Some(ParameterVersion::new(s.version, &s.values, &s.rig, &s.middles).camera.world_from_projector)
    }

    /// The newest version, and whether it is in use, can be taken back and is saved: for those who look whether
    /// anything has changed.
    pub fn mark(&self) -> Option<[u64; 3]> {
        let state = self.open()?;
        let s = state.as_ref()?;
        Some([s.version, self.used.load(Ordering::Acquire), u64::from(s.values != s.saved)])
    }

    /// Changes a parameter at `now_ns`. Returns the version, what has changed, and whether undo takes it back by itself.
    pub(crate) fn set(
        &self,
        name: &str,
        numbers: &[f64],
        now_ns: u64,
    ) -> Result<(u64, String, bool), ChangeRefusal> {
        let mut state = self.open().ok_or(ChangeRefusal::NoRun)?;
        let s = state.as_mut().ok_or(ChangeRefusal::NoRun)?;
        let parameter = Parameter::named(name, &s.rig)?;
        let mut values = s.values.clone();
        values.set(parameter, numbers, &s.rig)?;
        let told = format!("{name} is {}", told_of(&values.get(parameter)));
        if values == s.values {
            return Ok((s.version, told, false));
        }
        let is_step =
            !s.last.is_some_and(|(last, at)| last == parameter && now_ns.saturating_sub(at) < ONE_STEP_NS);
        if is_step {
            if s.before.len() >= MOST_KEPT {
                s.before.pop_front();
            }
            s.before.push_back(s.values.clone());
        }
        s.last = Some((parameter, now_ns));
        s.take_over(values);
        Ok((s.version, told, is_step))
    }

    /// Takes the last step back.
    pub(crate) fn undo(&self) -> Result<(u64, String), ChangeRefusal> {
        let mut state = self.open().ok_or(ChangeRefusal::NoRun)?;
        let s = state.as_mut().ok_or(ChangeRefusal::NoRun)?;
        let values = s.before.pop_back().ok_or(ChangeRefusal::NothingToUndo)?;
        let told = values.changes_since(&s.values, &s.rig);
        s.last = None;
        s.take_over(values);
        Ok((s.version, if told.is_empty() { "nothing has changed".into() } else { told }))
    }

    /// What the files do not say yet.
    pub(crate) fn to_keep(&self) -> Result<(Arc<Rig>, Values, ToKeep), ChangeRefusal> {
        let state = self.open().ok_or(ChangeRefusal::NoRun)?;
        let s = state.as_ref().ok_or(ChangeRefusal::NoRun)?;
        let (now, saved) = (&s.values, &s.saved);
        let mut keep = ToKeep::default();
        if now.exposure != saved.exposure {
            keep.keys.push((["render", "exposure"], Setting::Number(now.exposure)));
        }
        if now.samples != saved.samples {
            keep.keys.push((["render", "spp"], Setting::Whole(i64::from(now.samples))));
        }
        if now.budget != saved.budget {
            keep.keys.push((["render", "budget_spp"], Setting::Number(now.budget)));
        }
        if now.gaze != saved.gaze {
            keep.keys.push((["observer", "gaze"], gaze(now.gaze, &s.rig)));
        }
        let applied = ParameterVersion::new(s.version, now, &s.rig, &s.middles);
        if now.projector != saved.projector {
            keep.projector = Some(applied.camera.world_from_projector);
        }
        for (i, body) in s.rig.bodies.iter().enumerate() {
            if now.bodies.get(i) != saved.bodies.get(i) {
                keep.bodies.push((body.name.clone(), applied.mesh_to_body[i]));
            }
        }
        Ok((s.rig.clone(), now.clone(), keep))
    }

    /// The files say `values` now.
    pub(crate) fn kept(&self, values: Values) {
        if let Some(s) = self.state().as_mut() {
            s.saved = values;
        }
    }
}

impl ParameterHistory {
    fn take_over(&mut self, values: Values) {
        self.version += 1;
        self.to_planning.publish(ParameterVersion::new(self.version, &values, &self.rig, &self.middles));
        self.values = values;
    }
}

/// A gaze point, or what the rig file said when the run began.
fn gaze(point: Option<[f64; 3]>, rig: &Rig) -> Setting {
    let gaze = point.map_or_else(|| rig.config.observer.gaze.clone(), at_point);
    let keys = gaze.written().into_iter().filter_map(|(key, value)| Some((key, setting(&value)?)));
    let kind = ("kind", Setting::Text(gaze.word().to_owned()));
    Setting::Table(std::iter::once(kind).chain(keys).collect())
}

/// A value of the rig file as it is kept; `None` for one that no kept key has.
fn setting(value: &Value) -> Option<Setting> {
    Some(match value {
        Value::Float(number) => Setting::Number(*number),
        Value::Integer(number) => Setting::Whole(*number),
        Value::String(text) => Setting::Text(text.clone()),
        Value::Array(nodes) => {
            let number = |node: &SourceNode| match node.value {
                Value::Float(number) => Some(number),
                _ => None,
            };
            Setting::Point(nodes.iter().map(number).collect::<Option<Vec<_>>>()?.try_into().ok()?)
        }
        _ => return None,
    })
}
