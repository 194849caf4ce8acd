//! What a device keeps of renderers that are gone, for the next one that needs the same: layouts of bindings, and
//! compiled pipelines.
//!
//! A renderer is made anew for every scene and method of a comparison, and most of its passes are those of the one
//! before. The driver's compiler takes seconds for them, on software Vulkan even with a warm cache on disk. A pipeline
//! has one owner at a time: it is kept when that owner drops it, and taken by the next who asks for the same program.

use super::pipeline::BindingKind;
use ash::vk;
use dpm_handoff::path::Lock;
use std::collections::VecDeque;
use std::sync::{MutexGuard, PoisonError};

/// Most pipelines that are kept while nobody uses them: those of some six renderers, as a comparison of methods makes them
/// in turn. A rig makes few and never reaches it. On software Vulkan a large one holds 10 MB.
const MOST_KEPT: usize = 96;

/// What a pipeline was compiled from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct PipelineKey {
    /// The layout of its bindings. There is one of each kind on a device ([`DeviceStore::layouts`]).
    pub layout: vk::PipelineLayout,
    /// Its shader.
    pub spirv: &'static [u8],
    /// Specialization constants, each as id and value.
    pub constants: Vec<(u32, u32)>,
}

/// The bindings of a table, each with its kind.
type Bindings = Vec<(u32, BindingKind)>;

/// The layout of set 0, and that of the pipelines that use it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Layouts {
    pub set: vk::DescriptorSetLayout,
    pub pipeline: vk::PipelineLayout,
}

/// What a device keeps. Its locks are held for some comparisons only and never for a call of the driver, so a thread that
/// hangs in the driver holds up no other one.
#[derive(Debug, Default)]
pub(super) struct DeviceStore {
    layouts: Lock<Vec<(Bindings, Layouts)>>,
    /// The one that was given back last is at the end.
    pipelines: Lock<VecDeque<(PipelineKey, vk::Pipeline)>>,
}

impl DeviceStore {
    /// The layouts of these bindings, if there are any yet.
    pub(super) fn layouts(&self, bindings: &[(u32, BindingKind)]) -> Option<Layouts> {
        held(&self.layouts).iter().find(|(known, _)| known == bindings).map(|(_, layouts)| *layouts)
    }

    /// Keeps layouts until the device goes. Returns those of these bindings, and the others where another thread was quicker,
    /// to be destroyed.
    pub(super) fn keep_layouts(
        &self,
        bindings: &[(u32, BindingKind)],
        made: Layouts,
    ) -> (Layouts, Option<Layouts>) {
        let mut all = held(&self.layouts);
        if let Some((_, first)) = all.iter().find(|(known, _)| known == bindings) {
            return (*first, Some(made));
        }
        all.push((bindings.to_vec(), made));
        (made, None)
    }

    /// A pipeline of this program that nobody uses.
    pub(super) fn take(&self, key: &PipelineKey) -> Option<vk::Pipeline> {
        let mut all = held(&self.pipelines);
        let found = all.iter().rposition(|(known, _)| known == key)?;
        all.remove(found).map(|(_, pipeline)| pipeline)
    }

    /// Keeps a pipeline that nobody uses any more. The one that is too many is returned, to be destroyed.
    pub(super) fn give_back(&self, key: PipelineKey, pipeline: vk::Pipeline) -> Option<vk::Pipeline> {
        let mut all = held(&self.pipelines);
        all.push_back((key, pipeline));
        if all.len() > MOST_KEPT {
            all.pop_front().map(|(_, oldest)| oldest)
        } else {
            None
        }
    }

    /// Empties it, to destroy what it kept.
    pub(super) fn empty(&mut self) -> (Vec<vk::Pipeline>, Vec<Layouts>) {
        let pipelines = held(&self.pipelines).drain(..).map(|(_, pipeline)| pipeline).collect();
        let layouts = held(&self.layouts).drain(..).map(|(_, layouts)| layouts).collect();
        (pipelines, layouts)
    }
}

/// Locks a list. Nothing panics while it is locked.
fn held<T>(list: &Lock<T>) -> MutexGuard<'_, T> {
    list.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ash::vk::Handle as _;

    fn key(shader: &'static [u8], value: u32) -> PipelineKey {
        PipelineKey { layout: vk::PipelineLayout::null(), spirv: shader, constants: vec![(7, value)] }
    }

    #[test]
    fn a_pipeline_is_taken_once_and_only_by_who_asks_for_its_program() {
        let kept = DeviceStore::default();
        let [one, two] = [1, 2].map(vk::Pipeline::from_raw);
        assert_eq!(kept.give_back(key(b"a", 1), one), None);
        assert_eq!(kept.give_back(key(b"a", 2), two), None);
        assert_eq!(kept.take(&key(b"b", 1)), None);
        assert_eq!(kept.take(&key(b"a", 3)), None);
        let other = PipelineKey { layout: vk::PipelineLayout::from_raw(5), ..key(b"a", 1) };
        assert_eq!(kept.take(&other), None);
        assert_eq!(kept.take(&key(b"a", 1)), Some(one));
        assert_eq!(kept.take(&key(b"a", 1)), None);
        assert_eq!(kept.take(&key(b"a", 2)), Some(two));
    }

    #[test]
    fn what_was_not_used_for_longest_goes_first() {
        let mut kept = DeviceStore::default();
        let pipeline = |n: usize| vk::Pipeline::from_raw(n as u64 + 1);
        for n in 0..MOST_KEPT {
            assert_eq!(kept.give_back(key(b"a", n as u32), pipeline(n)), None);
        }
        // Used again, so it is not the oldest any more.
        assert_eq!(kept.take(&key(b"a", 0)), Some(pipeline(0)));
        assert_eq!(kept.give_back(key(b"a", 0), pipeline(0)), None);
        assert_eq!(kept.give_back(key(b"b", 0), pipeline(MOST_KEPT)), Some(pipeline(1)));
        assert_eq!(kept.empty().0.len(), MOST_KEPT);
        assert_eq!(kept.take(&key(b"a", 0)), None);
    }

    #[test]
    fn bindings_have_one_layout_each() {
        let kept = DeviceStore::default();
        let layouts = |n| Layouts {
            set: vk::DescriptorSetLayout::from_raw(n),
            pipeline: vk::PipelineLayout::from_raw(n),
        };
        let (few, more) = ([(0, BindingKind::Storage)], [(0, BindingKind::Storage), (1, BindingKind::Texel)]);
        assert!(kept.layouts(&few).is_none());
        assert_eq!(kept.keep_layouts(&few, layouts(1)), (layouts(1), None));
        assert!(kept.layouts(&more).is_none());
        assert_eq!(kept.keep_layouts(&more, layouts(2)), (layouts(2), None));
        assert_eq!(kept.keep_layouts(&few, layouts(3)), (layouts(1), Some(layouts(3))));
        assert_eq!(kept.layouts(&few), Some(layouts(1)));
        assert_eq!(kept.layouts(&more), Some(layouts(2)));
    }
}
