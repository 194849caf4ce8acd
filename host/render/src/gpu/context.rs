//! Picks a device and opens it.

use super::address_space;
use super::devices::{
    candidates, compute_family, has_priorities, has_timelines, queue_count, scratch_alignment, usable,
    Candidate, DeviceId, DeviceSummary, RAY_QUERY,
};
use super::error::GpuError;
use super::instance::{create_instance, Instance};
use super::kept::DeviceStore;
use super::leftovers::Leftovers;
use super::turn::{HeldTurn, Turn};
use ash::{khr, vk};
use std::ffi::{CStr, CString};
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicU64, AtomicU8, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How long to wait for the copies of a first start, nanoseconds. A slow machine may be busy with other things.
const FIRST_SETUP_WAIT_NS: u64 = 60_000_000_000;
/// Longest wait for another thread's turn at the queue.
const QUEUE_WAIT: Duration = Duration::from_secs(2);

/// How to open the GPU.
#[derive(Clone, Debug, Default)]
pub struct GpuOptions {
    /// Validation layers with synchronisation validation; ignored with a message when they are not installed.
    pub validation: bool,
    /// Part of the name of the device to use; `None`: the fastest kind there is.
    pub device: Option<String>,
    /// The driver keeps what its compiler made of each pipeline, for [`super::ComputePipeline::executables`]. Devices whose driver cannot are
    /// refused.
    pub statistics: bool,
    /// Memory that the frames take, bytes: devices with less are refused. 0: not known. Software Vulkan uses the machine's.
    pub memory_bytes: u64,
}

/// An open device. Shared by everything made from it; closed when the last of them is gone.
///
/// Once a device [is lost](Gpu::is_lost) it is not used any more: every call that would use it fails at once. A device that its driver reports as
/// lost is closed as any other. A device that was [given up](Gpu::give_up) because it did not finish may continue to use everything that it was
/// given. So nothing of it is freed before it has finished; [`memory_given_up`] returns how much memory waits for that.
pub struct Gpu {
    pub(super) device: ash::Device,
    /// Where frames begin and where they end. The same queue twice where the device has one.
    queues: [vk::Queue; 2],
    goes_first: bool,
    /// It has semaphores that count.
    has_timelines: bool,
    /// Whose turn it is to submit.
    turn: Turn,
    pub(super) queue_family: u32,
    pub(super) memory: vk::PhysicalDeviceMemoryProperties,
    pub(super) limits: vk::PhysicalDeviceLimits,
    summary: DeviceSummary,
    /// The device's name, for errors.
    name: Arc<str>,
    pub(super) id: DeviceId,
    pub(super) options: GpuOptions,
    /// Calls that ask what the compiler made of a pipeline, if the options asked for them.
    pub(super) statistics: Option<khr::pipeline_executable_properties::Device>,
    /// Calls for the trees of ray tracing, if the device has ray queries.
    pub(super) acceleration: Option<khr::acceleration_structure::Device>,
    /// At which multiples of an address such trees may be built, bytes.
    pub(super) scratch_alignment: u64,
    /// Layouts and compiled pipelines of renderers that are gone.
    pub(super) kept: DeviceStore,
    /// What was dropped while the device, given up, may still use it.
    pub(super) leftovers: Leftovers,
    instance: ManuallyDrop<Instance>,
    /// One of [`GpuState`].
    state: AtomicU8,
    /// Memory that buffers hold, bytes.
    held_bytes: AtomicU64,
    /// Software Vulkan in a process whose address space is limited: how much buffers may take of it, bytes.
    most_bytes: Option<u64>,
    /// How long copies at set-up are waited for, nanoseconds.
    setup_wait_ns: u64,
}

/// The state of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum GpuState {
    /// It works, as far as the program knows.
    Well,
    /// Its driver reports that it is lost. Nothing runs on it, and everything made from it may be destroyed.
    Lost,
    /// It did not finish in time, and may still use everything that it was given.
    GivenUp,
}

impl std::fmt::Debug for Gpu {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Gpu").field("device", &self.summary.name).finish()
    }
}

/// Memory of devices that were given up. It stays allocated until the device has finished what it was given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MemoryGivenUp {
    /// How many devices were given up so far.
    pub devices: u64,
    /// What their buffers still hold, bytes.
    pub bytes: u64,
}

static DEVICES_GIVEN_UP: AtomicU64 = AtomicU64::new(0);
pub(super) static BYTES_GIVEN_UP: AtomicU64 = AtomicU64::new(0);

/// Memory of all devices that this process gave up ([`Gpu::give_up`]).
pub fn memory_given_up() -> MemoryGivenUp {
    MemoryGivenUp {
        devices: DEVICES_GIVEN_UP.load(Ordering::Relaxed),
        bytes: BYTES_GIVEN_UP.load(Ordering::Relaxed),
    }
}

/// What [`create`] has made.
struct NewDevice {
    device: ash::Device,
    queue_family: u32,
    queues: [vk::Queue; 2],
    /// Frames go before the work of other programs.
    goes_first: bool,
    /// It has semaphores that count.
    has_timelines: bool,
    /// Most that buffers may take of the address space.
    most_bytes: Option<u64>,
}

/// Creates the device with its queues.
fn create(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    summary: &DeviceSummary,
    options: &GpuOptions,
) -> Result<NewDevice, GpuError> {
    let name: Arc<str> = summary.name.as_str().into();
    let most_bytes =
        if summary.software { address_space::for_buffers().map_err(|e| e.on(&name))? } else { None };
    let queue_family = compute_family(instance, physical).ok_or_else(|| GpuError::NoDevice {
        found: summary.name.clone(),
        needed: "a compute queue".into(),
    })?;
    let has_timelines = has_timelines(instance, physical);
    let queue_count = if has_timelines { queue_count(instance, physical, queue_family) } else { 1 };
    // What ends a frame goes first, because its light waits for it.
    let priorities = &[0.5, 1.0][2 - queue_count as usize..];
    // On a desktop the compositor's work would stand before a frame for a millisecond or more. Drivers give way to programs that the system lets.
    let asks_first = if summary.software { None } else { has_priorities(instance, physical) };
    let device = |first: Option<&'static CStr>| {
        let has = (has_timelines, summary.ray_query);
        open_with(instance, physical, (queue_family, priorities), has, first, options)
    };
    let (device, goes_first) = match asks_first.and_then(|extension| device(Some(extension)).ok()) {
        Some(device) => (device, true),
        None => (
            device(None).map_err(|e| {
                GpuError::from_result(e, "opening the Vulkan device", &name, summary.memory_mib)
            })?,
            false,
        ),
    };
    // SAFETY: the device was created with so many queues of this family.
    let queues = [0, queue_count - 1].map(|i| unsafe { device.get_device_queue(queue_family, i) });
    Ok(NewDevice { device, queue_family, queues, goes_first, has_timelines, most_bytes })
}

/// The device with the features that the shaders need, and with semaphores that count and ray queries where it has them. `first`: the extension by
/// which its queues go before those of other programs.
fn open_with(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    (queue_family, priorities): (u32, &[f32]),
    (has_timelines, has_ray_queries): (bool, bool),
    first: Option<&'static CStr>,
    options: &GpuOptions,
) -> Result<ash::Device, vk::Result> {
    let mut before_others = vk::DeviceQueueGlobalPriorityCreateInfoKHR::default()
        .global_priority(vk::QueueGlobalPriorityKHR::HIGH);
    let mut queue =
        vk::DeviceQueueCreateInfo::default().queue_family_index(queue_family).queue_priorities(priorities);
    if first.is_some() {
        queue = queue.push_next(&mut before_others);
    }
    let queues = [queue];
    let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default()
        .timeline_semaphore(has_timelines)
        .buffer_device_address(has_ray_queries)
        .scalar_block_layout(true)
        .shader_buffer_int64_atomics(true);
    let features = vk::PhysicalDeviceFeatures::default().shader_int64(true);
    let mut info = vk::DeviceCreateInfo::default()
        .queue_create_infos(&queues)
        .enabled_features(&features)
        .push_next(&mut vulkan12);
    let mut executable =
        vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default().pipeline_executable_info(true);
    let statistics = options.statistics.then_some(khr::pipeline_executable_properties::NAME);
    let of_queries = RAY_QUERY.into_iter().filter(|_| has_ray_queries);
    let extensions: Vec<_> =
        statistics.into_iter().chain(first).chain(of_queries).map(CStr::as_ptr).collect();
    info = info.enabled_extension_names(&extensions);
    let mut trees =
        vk::PhysicalDeviceAccelerationStructureFeaturesKHR::default().acceleration_structure(true);
    let mut queries = vk::PhysicalDeviceRayQueryFeaturesKHR::default().ray_query(true);
    if has_ray_queries {
        info = info.push_next(&mut trees).push_next(&mut queries);
    }
    if options.statistics {
        info = info.push_next(&mut executable);
    }
    // SAFETY: `info` and what it points to live until the call returns.
    unsafe { instance.create_device(physical, &info, None) }
}

/// The devices in words.
fn listed(candidates: &[Candidate]) -> String {
    let one =
        |c: &Candidate| format!("{} ({})", c.summary.name, c.summary.refused.as_deref().unwrap_or("usable"));
    match candidates {
        [] => "none".into(),
        all => all.iter().map(one).collect::<Vec<_>>().join(", "),
    }
}

/// Why none of the devices that were `found` is opened.
fn no_device(options: &GpuOptions, only: Option<&DeviceId>, found: String) -> GpuError {
    let name =
        options.device.as_ref().map_or(String::new(), |d| format!(" and a name that contains \"{d}\""));
    let which = only.map_or(String::new(), |id| format!(", the very {} that was lost", id.name));
    let needed = format!("Vulkan 1.2 with scalarBlockLayout and shaderBufferInt64Atomics{name}{which}");
    GpuError::NoDevice { found, needed }
}

impl Gpu {
    /// All devices that the loader knows.
    ///
    /// # Errors
    /// [`GpuError::NoLoader`], [`GpuError::NoDriver`].
    pub fn list() -> Result<Vec<DeviceSummary>, GpuError> {
        let instance = create_instance(false)?;
        Ok(candidates(&instance, &GpuOptions::default())?.into_iter().map(|c| c.summary).collect())
    }

    /// Opens a device: discrete before integrated before software, or the one whose name contains `options.device`.
    ///
    /// # Errors
    /// No loader, no driver, no device that has what is needed (the text lists them), too little address space for software Vulkan, or
    /// Vulkan's own. Nothing of Vulkan is left open then.
    pub fn open(options: &GpuOptions) -> Result<Arc<Self>, GpuError> {
        Self::open_device(options, None, FIRST_SETUP_WAIT_NS)
    }

    /// Looks whether there is a device that [`Gpu::open`] would try to open, and opens none.
    ///
    /// # Errors
    /// No loader, no driver, or no device that has what is needed.
    pub fn look(options: &GpuOptions) -> Result<(), GpuError> {
        let instance = create_instance(false)?;
        let candidates = candidates(&instance, options)?;
        let found = listed(&candidates);
        let is_there = !usable(&instance, candidates, options).is_empty();
        is_there.then_some(()).ok_or_else(|| no_device(options, None, found))
    }

    /// The devices that the options allow, best first.
    pub(super) fn ranked(options: &GpuOptions) -> Result<Vec<DeviceId>, GpuError> {
        let instance = create_instance(options.validation)?;
        let all = candidates(&instance, options)?;
        Ok(usable(&instance, all, options).into_iter().map(|c| c.id).collect())
    }

    /// Opens the device `only`, or the best that the options allow; copies at set-up may take `setup_wait_ns`.
    pub(super) fn open_device(
        options: &GpuOptions,
        only: Option<&DeviceId>,
        setup_wait_ns: u64,
    ) -> Result<Arc<Self>, GpuError> {
        let instance = create_instance(options.validation)?;
        let candidates = candidates(&instance, options)?;
        let found = listed(&candidates);
        let mut usable = usable(&instance, candidates, options);
        usable.retain(|c| only.is_none_or(|id| c.id == *id));
        let mut first_error = None;
        for Candidate { physical, summary, id } in usable {
            let name: Arc<str> = summary.name.as_str().into();
            let NewDevice { device, queue_family, queues, goes_first, has_timelines, most_bytes } =
                match create(&instance, physical, &summary, options) {
                    Ok(created) => created,
                    Err(error) => {
                        tracing::warn!("{name} is passed over: {error}");
                        first_error.get_or_insert(error);
                        continue;
                    }
                };
            let statistics = options
                .statistics
                .then(|| khr::pipeline_executable_properties::Device::new(&instance.handle, &device));
            let acceleration = summary
                .ray_query
                .then(|| khr::acceleration_structure::Device::new(&instance.handle, &device));
            let scratch_alignment =
                if summary.ray_query { scratch_alignment(&instance, physical) } else { 1 };
            // SAFETY: plain queries.
            let (memory, limits) = unsafe {
                (
                    instance.get_physical_device_memory_properties(physical),
                    instance.get_physical_device_properties(physical).limits,
                )
            };
            return Ok(Arc::new(Self {
                device,
                queues,
                goes_first,
                has_timelines,
                turn: Turn::default(),
                queue_family,
                memory,
                limits,
                summary,
                name,
                id,
                options: options.clone(),
                statistics,
                acceleration,
                scratch_alignment,
                kept: DeviceStore::default(),
                leftovers: Leftovers::default(),
                instance: ManuallyDrop::new(instance),
                state: AtomicU8::new(GpuState::Well as u8),
                held_bytes: AtomicU64::new(0),
                most_bytes,
                setup_wait_ns,
            }));
        }
        Err(first_error.unwrap_or_else(|| no_device(options, only, found)))
    }

    /// Describes this device.
    pub fn summary(&self) -> &DeviceSummary {
        &self.summary
    }

    /// The device's name, for errors.
    pub(super) fn device_name(&self) -> &Arc<str> {
        &self.name
    }

    /// Most elements of a texel buffer.
    pub(crate) fn max_texel_elements(&self) -> u64 {
        u64::from(self.limits.max_texel_buffer_elements)
    }

    /// Largest buffer that shaders can be given whole, bytes: as storage, and on software Vulkan also as texels of 16 bytes.
    pub fn max_buffer_bytes(&self) -> u64 {
        let storage = u64::from(self.limits.max_storage_buffer_range);
        if self.summary.software {
            storage.min(self.max_texel_elements() * 16)
        } else {
            storage
        }
    }

    pub(super) fn name(text: &str) -> CString {
        CString::new(text).unwrap_or_default()
    }

    /// How long a copy at set-up is waited for, nanoseconds.
    pub(super) fn setup_wait_ns(&self) -> u64 {
        self.setup_wait_ns
    }

    /// Size of the largest heap, MiB.
    pub(super) fn heap_mib(&self) -> u64 {
        let heaps = &self.memory.memory_heaps[..self.memory.memory_heap_count as usize];
        heaps.iter().map(|h| h.size >> 20).max().unwrap_or(0)
    }
}

/// Results with the device and the operation in their errors.
pub(super) trait On<T> {
    /// The device remembers a loss.
    fn on(self, gpu: &Gpu, operation: &'static str) -> Result<T, GpuError>;
}

impl<T> On<T> for Result<T, vk::Result> {
    fn on(self, gpu: &Gpu, operation: &'static str) -> Result<T, GpuError> {
        self.map_err(|result| {
            if result == vk::Result::ERROR_DEVICE_LOST {
                gpu.becomes(GpuState::Lost);
            }
            GpuError::from_result(result, operation, &gpu.name, gpu.heap_mib())
        })
    }
}

impl Gpu {
    /// True once the driver reported the device as lost, or [`Gpu::give_up`] was called. Every use of it fails from then on, and
    /// [`Gpu::reopen`] opens another.
    pub fn is_lost(&self) -> bool {
        self.state() != GpuState::Well
    }

    /// Gives up a device that does not finish. Nothing is submitted to it any more, and dropping what was made from it returns at once: what the device
    /// may still use is destroyed when it has finished. Calling it again changes nothing.
    pub fn give_up(&self) {
        if self.becomes(GpuState::GivenUp) {
            let bytes = self.held_bytes.load(Ordering::Relaxed);
            DEVICES_GIVEN_UP.fetch_add(1, Ordering::Relaxed);
            BYTES_GIVEN_UP.fetch_add(bytes, Ordering::Relaxed);
            tracing::warn!(
                "{} did not finish and was given up; {} MiB of its memory stay taken until it has finished",
                self.name,
                bytes.div_ceil(1 << 20)
            );
        }
    }

    fn state(&self) -> GpuState {
        match self.state.load(Ordering::Acquire) {
            0 => GpuState::Well,
            1 => GpuState::Lost,
            _ => GpuState::GivenUp,
        }
    }

    /// Changes the state of a device that works, and returns whether it did. The first fault of a device stays.
    fn becomes(&self, state: GpuState) -> bool {
        let well = GpuState::Well as u8;
        self.state.compare_exchange(well, state as u8, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Refuses to use a device that is lost or was given up.
    pub(super) fn alive(&self, operation: &'static str) -> Result<(), GpuError> {
        let device = || self.name.clone();
        match self.state() {
            GpuState::Well => Ok(()),
            GpuState::Lost => Err(GpuError::DeviceLost { operation, device: device() }),
            GpuState::GivenUp => Err(GpuError::GivenUp { operation, device: device() }),
        }
    }

    /// True when the device may still use what was made from it.
    pub(super) fn is_abandoned(&self) -> bool {
        self.state() == GpuState::GivenUp
    }

    /// The queues, for one submission: as long as the turn is held. In a rig one thread submits, so the turn is free.
    pub(super) fn queues(&self) -> Result<([vk::Queue; 2], HeldTurn<'_>), GpuError> {
        let turn = self.turn.take().map_or_else(|| self.wait_for_turn(), Ok)?;
        Ok((self.queues, turn))
    }

    /// Whether frames go before the work of other programs, because the driver offers that and the system lets this program.
    pub fn goes_first(&self) -> bool {
        self.goes_first
    }

    /// Whether device and host can take turns within a frame ([`super::Relay`]).
    pub(crate) fn has_timelines(&self) -> bool {
        self.has_timelines
    }

    /// Whether a frame can begin on one queue while the one before ends on another.
    pub fn has_two_queues(&self) -> bool {
        self.queues[0] != self.queues[1]
    }

    /// Waits for another thread's submission: one of an abandoned crew, or of another renderer in a test.
    #[cold]
    fn wait_for_turn(&self) -> Result<HeldTurn<'_>, GpuError> {
        let begin = Instant::now();
        loop {
            // The other thread may be in a call of the driver that does not return.
            self.alive("submitting")?;
            if begin.elapsed() >= QUEUE_WAIT {
                let waited_ms = QUEUE_WAIT.as_millis() as u64;
                return Err(GpuError::Timeout { device: self.name.clone(), waited_ms });
            }
            std::thread::sleep(Duration::from_micros(200));
            if let Some(turn) = self.turn.take() {
                return Ok(turn);
            }
        }
    }

    /// Checks whether there is room, before memory for a buffer is allocated.
    ///
    /// # Errors
    /// [`GpuError::AddressSpace`]: without the rest of the address space software Vulkan would crash.
    pub(super) fn takes(&self, bytes: u64) -> Result<(), GpuError> {
        let held = self.held_bytes.load(Ordering::Relaxed);
        if let Some(most) = self.most_bytes.filter(|most| held.saturating_add(bytes) > *most) {
            return Err(address_space::short_of(held.saturating_add(bytes) - most).on(&self.name));
        }
        Ok(())
    }

    /// Counts memory of a buffer that was allocated or freed.
    pub(super) fn holds(&self, more_bytes: u64, fewer_bytes: u64) {
        self.held_bytes.fetch_add(more_bytes, Ordering::Relaxed);
        self.held_bytes.fetch_sub(fewer_bytes, Ordering::Relaxed);
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        if self.has_leftovers() {
            return;
        }
        // SAFETY: everything made from the device holds an Arc to this, so it is all gone, and every submission was waited for by its
        // fence (or is over because the device is lost): there is nothing left to wait for. The instance goes last.
        unsafe {
            let (pipelines, layouts) = self.kept.empty();
            for pipeline in pipelines {
                self.device.destroy_pipeline(pipeline, None);
            }
            for layouts in layouts {
                layouts.destroy(&self.device);
            }
            self.device.destroy_device(None);
            ManuallyDrop::drop(&mut self.instance);
        }
    }
}
