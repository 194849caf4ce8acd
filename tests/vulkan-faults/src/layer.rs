//! The functions that stand before those of the driver.
//!
//! Objects are found by the first word of their handle, which the loader makes the same for an instance and its physical devices, and for
//! a device, its queues and its command buffers.
#![allow(unsafe_code)]

use crate::interface::{find_in_chain, DeviceLink, InstanceLink, LINK_INFO, LOADER_DATA_CALLBACK};
use crate::plan::{Call, Fault, Kind};
use crate::state::{arrive, arrive_for, tell};
use ash::vk::{self, Handle};
use std::collections::{HashMap, HashSet, VecDeque};
use std::ffi::{c_char, c_void, CStr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// How long the layer sleeps between looks while it keeps somebody waiting.
const SLICE: Duration = Duration::from_millis(1);
/// A wait without a bound on a GPU that hangs: systems reset such a GPU some time, and then the device is lost.
const RESET_AFTER: Duration = Duration::from_secs(30);
/// A quiet NaN, and as an integer larger than any count.
const NOT_A_NUMBER: u32 = 0x7fc0_0000;

type SetDeviceLoaderData = unsafe extern "system" fn(vk::Device, *mut c_void) -> vk::Result;

struct InstanceData {
    handle: vk::Instance,
    get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr,
    fns: ash::InstanceFnV1_0,
    /// The loader's list.
    devices: Mutex<Vec<vk::PhysicalDevice>>,
}

struct DeviceData {
    handle: vk::Device,
    get_device_proc_addr: vk::PFN_vkGetDeviceProcAddr,
    set_loader_data: Option<SetDeviceLoaderData>,
    fns: ash::DeviceFnV1_0,
    lost: AtomicBool,
    /// The program was told so: what it submits from then on it should not have.
    told: AtomicBool,
    state: Mutex<DeviceState>,
}

#[derive(Default)]
struct DeviceState {
    /// Submissions that the driver has not seen yet, oldest first.
    held: VecDeque<Held>,
    /// Fences that are signalled no earlier than this.
    late: HashMap<vk::Fence, Instant>,
    /// Command buffers with an indirect dispatch.
    frames: HashSet<vk::CommandBuffer>,
    sizes: HashMap<vk::Buffer, u64>,
    families: HashMap<vk::Queue, u32>,
    pools: Vec<vk::CommandPool>,
}

struct Held {
    queue: vk::Queue,
    fence: vk::Fence,
    batches: Vec<Batch>,
    /// `None`: never.
    until: Option<Instant>,
}

/// A `VkSubmitInfo` with what it points to.
struct Batch {
    waits: Vec<vk::Semaphore>,
    stages: Vec<vk::PipelineStageFlags>,
    buffers: Vec<vk::CommandBuffer>,
    signals: Vec<vk::Semaphore>,
}

type Table<T> = OnceLock<Mutex<HashMap<usize, Arc<T>>>>;
static INSTANCES: Table<InstanceData> = OnceLock::new();
static DEVICES: Table<DeviceData> = OnceLock::new();

fn lock<T>(m: &Mutex<T>) -> MutexGuard<'_, T> {
    m.lock().unwrap_or_else(PoisonError::into_inner)
}

fn table<T>(table: &'static Table<T>) -> MutexGuard<'static, HashMap<usize, Arc<T>>> {
    lock(table.get_or_init(Mutex::default))
}

/// # Safety
/// `handle` is a live dispatchable handle.
unsafe fn key(handle: impl Handle) -> usize {
    // SAFETY: dispatchable handles point to memory that begins with the loader's pointer.
    unsafe { *(handle.as_raw() as *const usize) }
}

/// # Safety
/// `handle` is a live device, queue or command buffer that was made through this layer.
unsafe fn device(handle: impl Handle) -> Arc<DeviceData> {
    // SAFETY: see above.
    let key = unsafe { key(handle) };
    table(&DEVICES).get(&key).cloned().expect("a device that was made through this layer")
}

/// # Safety
/// `handle` is a live instance or physical device that was made through this layer.
unsafe fn instance(handle: impl Handle) -> Arc<InstanceData> {
    // SAFETY: see above.
    let key = unsafe { key(handle) };
    table(&INSTANCES).get(&key).cloned().expect("an instance that was made through this layer")
}

/// The answer that a plan wants of a call that is otherwise only counted.
fn failure(fault: Option<Fault>) -> Option<vk::Result> {
    match fault?.kind {
        Kind::Fail(result) => Some(result),
        _ => None,
    }
}

/// # Safety
/// As `vkCreateInstance` for a layer.
unsafe extern "system" fn create_instance(
    info: *const vk::InstanceCreateInfo<'_>,
    allocator: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::Instance,
) -> vk::Result {
    // SAFETY: the loader's chain, link and functions are valid during the call; the link is advanced for the next layer, as layers must.
    unsafe {
        let loader = vk::StructureType::LOADER_INSTANCE_CREATE_INFO;
        let Some(link_info) = find_in_chain((*info).p_next, loader, LINK_INFO) else {
            return vk::Result::ERROR_INITIALIZATION_FAILED;
        };
        if let Some(result) = failure(arrive(&[Call::Instance, Call::Create])) {
            return result;
        }
        let link = (*link_info).u.cast::<InstanceLink>();
        let get_instance_proc_addr = (*link).get_instance_proc_addr;
        (*link_info).u = (*link).next.cast();
        let Some(create) = get_instance_proc_addr(vk::Instance::null(), c"vkCreateInstance".as_ptr()) else {
            return vk::Result::ERROR_INITIALIZATION_FAILED;
        };
        let create = std::mem::transmute::<unsafe extern "system" fn(), vk::PFN_vkCreateInstance>(create);
        let result = create(info, allocator, out);
        if result == vk::Result::SUCCESS {
            let handle = *out;
            let fns =
                ash::InstanceFnV1_0::load(|name| address(get_instance_proc_addr(handle, name.as_ptr())));
            let data = InstanceData { handle, get_instance_proc_addr, fns, devices: Mutex::default() };
            table(&INSTANCES).insert(key(handle), Arc::new(data));
        }
        result
    }
}

fn address(function: vk::PFN_vkVoidFunction) -> *const c_void {
    function.map_or(std::ptr::null(), |f| f as *const c_void)
}

/// # Safety
/// As `vkDestroyInstance`.
unsafe extern "system" fn destroy_instance(
    handle: vk::Instance,
    allocator: *const vk::AllocationCallbacks<'_>,
) {
    if handle.is_null() {
        return;
    }
    // SAFETY: the caller's.
    unsafe {
        let data = instance(handle);
        table(&INSTANCES).remove(&key(handle));
        (data.fns.destroy_instance)(handle, allocator);
    }
}

/// # Safety
/// As `vkEnumeratePhysicalDevices`.
unsafe extern "system" fn enumerate_physical_devices(
    handle: vk::Instance,
    count: *mut u32,
    out: *mut vk::PhysicalDevice,
) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        if let Some(result) = failure(arrive(&[Call::Create])) {
            return result;
        }
        let data = instance(handle);
        let result = (data.fns.enumerate_physical_devices)(handle, count, out);
        if result == vk::Result::SUCCESS && !out.is_null() {
            *lock(&data.devices) = list(out.cast_const(), *count);
        }
        result
    }
}

/// # Safety
/// As `vkCreateDevice` for a layer.
unsafe extern "system" fn create_device(
    physical: vk::PhysicalDevice,
    info: *const vk::DeviceCreateInfo<'_>,
    allocator: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::Device,
) -> vk::Result {
    // SAFETY: as in `create_instance`.
    unsafe {
        let loader = vk::StructureType::LOADER_DEVICE_CREATE_INFO;
        let Some(link_info) = find_in_chain((*info).p_next, loader, LINK_INFO) else {
            return vk::Result::ERROR_INITIALIZATION_FAILED;
        };
        let parent = instance(physical);
        let place = lock(&parent.devices).iter().position(|&d| d == physical).map(|place| place as u64 + 1);
        if let Some(result) = failure(arrive_for(&[Call::Device, Call::Create], place)) {
            return result;
        }
        let set_loader_data = find_in_chain((*info).p_next, loader, LOADER_DATA_CALLBACK)
            .map(|callback| std::mem::transmute::<*mut c_void, SetDeviceLoaderData>((*callback).u));
        let link = (*link_info).u.cast::<DeviceLink>();
        let get_instance_proc_addr = (*link).get_instance_proc_addr;
        let get_device_proc_addr = (*link).get_device_proc_addr;
        (*link_info).u = (*link).next.cast();
        let Some(create) = get_instance_proc_addr(parent.handle, c"vkCreateDevice".as_ptr()) else {
            return vk::Result::ERROR_INITIALIZATION_FAILED;
        };
        let create = std::mem::transmute::<unsafe extern "system" fn(), vk::PFN_vkCreateDevice>(create);
        let result = create(physical, info, allocator, out);
        if result == vk::Result::SUCCESS {
            let handle = *out;
            let fns = ash::DeviceFnV1_0::load(|name| address(get_device_proc_addr(handle, name.as_ptr())));
            let data = DeviceData {
                handle,
                get_device_proc_addr,
                set_loader_data,
                fns,
                lost: AtomicBool::new(false),
                told: AtomicBool::new(false),
                state: Mutex::default(),
            };
            table(&DEVICES).insert(key(handle), Arc::new(data));
        }
        result
    }
}

/// # Safety
/// As `vkDestroyDevice`.
unsafe extern "system" fn destroy_device(handle: vk::Device, allocator: *const vk::AllocationCallbacks<'_>) {
    if handle.is_null() {
        return;
    }
    // SAFETY: the caller's; the pools are the layer's own, and what was recorded in them is over when a device is destroyed.
    unsafe {
        let data = device(handle);
        table(&DEVICES).remove(&key(handle));
        for pool in lock(&data.state).pools.drain(..) {
            (data.fns.destroy_command_pool)(handle, pool, std::ptr::null());
        }
        (data.fns.destroy_device)(handle, allocator);
    }
}

impl DeviceData {
    fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Acquire)
    }

    /// From now on the device is lost. What the driver below still does for it ends first: a program may destroy everything then.
    fn lose(&self) -> vk::Result {
        let mut state = lock(&self.state);
        state.held.clear();
        self.lost.store(true, Ordering::Release);
        // SAFETY: the lock keeps other submissions of this layer away.
        let _ = unsafe { (self.fns.device_wait_idle)(self.handle) };
        self.told.store(true, Ordering::Release);
        vk::Result::ERROR_DEVICE_LOST
    }

    /// Hands the driver what was held long enough.
    fn release_due(&self, state: &mut DeviceState) {
        while let Some(first) = state.held.front() {
            if first.until.is_none_or(|until| Instant::now() < until) {
                return;
            }
            let Some(Held { queue, fence, batches, .. }) = state.held.pop_front() else { return };
            let infos: Vec<_> = batches
                .iter()
                .map(|b| {
                    vk::SubmitInfo::default()
                        .wait_semaphores(&b.waits)
                        .wait_dst_stage_mask(&b.stages)
                        .command_buffers(&b.buffers)
                        .signal_semaphores(&b.signals)
                })
                .collect();
            // SAFETY: the program keeps what it submitted alive until its fence is signalled; the lock keeps other submissions away.
            let result = unsafe { (self.fns.queue_submit)(queue, infos.len() as u32, infos.as_ptr(), fence) };
            if result != vk::Result::SUCCESS {
                eprintln!("vulkan-faults: a submission that was held back failed: {result:?}");
            }
        }
    }

    /// The layer itself keeps this fence from being signalled.
    fn keeps_back(state: &DeviceState, fence: vk::Fence) -> bool {
        state.held.iter().any(|h| h.fence == fence)
            || state.late.get(&fence).is_some_and(|until| Instant::now() < *until)
    }

    /// Waits until nothing is held back.
    fn wait_for_held(&self) -> Option<vk::Result> {
        let end = Instant::now() + RESET_AFTER;
        loop {
            if self.is_lost() {
                return Some(vk::Result::ERROR_DEVICE_LOST);
            }
            {
                let mut state = lock(&self.state);
                self.release_due(&mut state);
                if state.held.is_empty() {
                    return None;
                }
            }
            if Instant::now() >= end {
                eprintln!("vulkan-faults: a wait without a bound on a GPU that hangs");
                return Some(self.lose());
            }
            std::thread::sleep(SLICE);
        }
    }

    /// Fills every buffer of exactly `bytes` bytes with floats that are not numbers, before what is submitted next.
    ///
    /// # Safety
    /// `queue` is of this device, and the caller may submit to it.
    unsafe fn poison(&self, state: &mut DeviceState, queue: vk::Queue, bytes: u64) {
        let f = &self.fns;
        let Some(&family) = state.families.get(&queue) else {
            return eprintln!("vulkan-faults: poison: a queue of which the family is not known");
        };
        // SAFETY: valid create infos; the pool goes with the device. The loader must know command buffers that a layer makes.
        unsafe {
            let info = vk::CommandPoolCreateInfo::default().queue_family_index(family);
            let mut pool = vk::CommandPool::null();
            if (f.create_command_pool)(self.handle, &info, std::ptr::null(), &mut pool) != vk::Result::SUCCESS
            {
                return eprintln!("vulkan-faults: poison: no command pool");
            }
            state.pools.push(pool);
            let info = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            let mut buffer = vk::CommandBuffer::null();
            if (f.allocate_command_buffers)(self.handle, &info, &mut buffer) != vk::Result::SUCCESS {
                return eprintln!("vulkan-faults: poison: no command buffer");
            }
            if let Some(set) = self.set_loader_data {
                let _ = set(self.handle, buffer.as_raw() as *mut c_void);
            }
            let _ = (f.begin_command_buffer)(buffer, &vk::CommandBufferBeginInfo::default());
            self.barrier(buffer);
            let mut filled = 0;
            for (&target, _) in state.sizes.iter().filter(|(_, &size)| size == bytes) {
                (f.cmd_fill_buffer)(buffer, target, 0, vk::WHOLE_SIZE, NOT_A_NUMBER);
                filled += 1;
            }
            self.barrier(buffer);
            let _ = (f.end_command_buffer)(buffer);
            if filled == 0 {
                eprintln!("vulkan-faults: poison: there is no buffer of {bytes} bytes");
            }
            let buffers = [buffer];
            let info = vk::SubmitInfo::default().command_buffers(&buffers);
            let result = (f.queue_submit)(queue, 1, &info, vk::Fence::null());
            if result != vk::Result::SUCCESS {
                eprintln!("vulkan-faults: poison: {result:?}");
            }
        }
    }

    /// Everything before is over before anything after begins.
    ///
    /// # Safety
    /// `buffer` is being recorded.
    unsafe fn barrier(&self, buffer: vk::CommandBuffer) {
        let all = vk::AccessFlags::MEMORY_READ | vk::AccessFlags::MEMORY_WRITE;
        let barrier = vk::MemoryBarrier::default().src_access_mask(all).dst_access_mask(all);
        let stages = vk::PipelineStageFlags::ALL_COMMANDS;
        // SAFETY: the caller's.
        unsafe {
            (self.fns.cmd_pipeline_barrier)(
                buffer,
                stages,
                stages,
                vk::DependencyFlags::empty(),
                1,
                &barrier,
                0,
                std::ptr::null(),
                0,
                std::ptr::null(),
            );
        }
    }
}

/// # Safety
/// `count` elements at `first`, or none.
unsafe fn list<T: Copy>(first: *const T, count: u32) -> Vec<T> {
    if first.is_null() || count == 0 {
        return Vec::new();
    }
    // SAFETY: see above.
    unsafe { std::slice::from_raw_parts(first, count as usize) }.to_vec()
}

/// # Safety
/// As `vkQueueSubmit`.
unsafe extern "system" fn queue_submit(
    queue: vk::Queue,
    count: u32,
    submits: *const vk::SubmitInfo<'_>,
    fence: vk::Fence,
) -> vk::Result {
    // SAFETY: the caller's.
    let (data, batches) = unsafe {
        let batches: Vec<_> = list(submits, count)
            .iter()
            .map(|s| Batch {
                waits: list(s.p_wait_semaphores, s.wait_semaphore_count),
                stages: list(s.p_wait_dst_stage_mask, s.wait_semaphore_count),
                buffers: list(s.p_command_buffers, s.command_buffer_count),
                signals: list(s.p_signal_semaphores, s.signal_semaphore_count),
            })
            .collect();
        (device(queue), batches)
    };
    let is_frame = {
        let state = lock(&data.state);
        batches.iter().flat_map(|b| &b.buffers).any(|b| state.frames.contains(b))
    };
    if data.is_lost() {
        if data.told.load(Ordering::Acquire) {
            tell(Call::SubmitAfterLoss);
        }
        return vk::Result::ERROR_DEVICE_LOST;
    }
    let calls: &[Call] = if is_frame { &[Call::Frame, Call::Submit] } else { &[Call::Submit] };
    let fault = arrive(calls);
    let ms = fault.and_then(|f| f.ms).map(Duration::from_millis);
    let mut hold = None;
    match fault.map(|f| f.kind) {
        Some(Kind::Lost) => return data.lose(),
        Some(Kind::Fail(result)) => return result,
        Some(Kind::Block) => match ms {
            Some(ms) => std::thread::sleep(ms),
            None => loop {
                std::thread::sleep(Duration::from_secs(3600));
            },
        },
        Some(Kind::Hang) => hold = Some(ms.map(|ms| Instant::now() + ms)),
        _ => {}
    }
    let mut state = lock(&data.state);
    // Lost meanwhile: what the driver got now would still run when the program has destroyed it.
    if data.is_lost() {
        return vk::Result::ERROR_DEVICE_LOST;
    }
    data.release_due(&mut state);
    if hold.is_some() || !state.held.is_empty() {
        // A queue keeps its order: what comes behind waits too.
        let until = hold.unwrap_or(Some(Instant::now()));
        state.held.push_back(Held { queue, fence, batches, until });
        return vk::Result::SUCCESS;
    }
    if let (Some(Kind::Late), Some(ms)) = (fault.map(|f| f.kind), ms) {
        state.late.insert(fence, Instant::now() + ms);
    }
    // SAFETY: the caller's; the lock keeps the layer's own submissions away.
    unsafe {
        if let Some(Fault { kind: Kind::Poison, bytes, .. }) = fault {
            data.poison(&mut state, queue, bytes);
        }
        (data.fns.queue_submit)(queue, count, submits, fence)
    }
}

/// # Safety
/// As `vkWaitForFences`.
unsafe extern "system" fn wait_for_fences(
    handle: vk::Device,
    count: u32,
    fences: *const vk::Fence,
    wait_all: vk::Bool32,
    timeout_ns: u64,
) -> vk::Result {
    // SAFETY: the caller's.
    let (data, all) = unsafe { (device(handle), list(fences, count)) };
    match arrive(&[Call::Wait]).map(|f| f.kind) {
        Some(Kind::Lost) => return data.lose(),
        Some(Kind::Fail(result)) => return result,
        _ => {}
    }
    let begin = Instant::now();
    // Centuries do for a wait without a bound.
    let timeout = Duration::from_nanos(timeout_ns);
    loop {
        if data.is_lost() {
            return vk::Result::ERROR_DEVICE_LOST;
        }
        let free: Vec<_> = {
            let mut state = lock(&data.state);
            data.release_due(&mut state);
            all.iter().copied().filter(|&f| !DeviceData::keeps_back(&state, f)).collect()
        };
        let left = timeout.saturating_sub(begin.elapsed());
        if free.len() == all.len() {
            let left_ns = u64::try_from(left.as_nanos()).unwrap_or(u64::MAX);
            // SAFETY: the caller's.
            return unsafe { (data.fns.wait_for_fences)(handle, count, fences, wait_all, left_ns) };
        }
        if wait_all == vk::FALSE && !free.is_empty() {
            // SAFETY: some of the caller's fences.
            let result =
                unsafe { (data.fns.wait_for_fences)(handle, free.len() as u32, free.as_ptr(), vk::FALSE, 0) };
            if result != vk::Result::TIMEOUT {
                return result;
            }
        }
        if left.is_zero() {
            return vk::Result::TIMEOUT;
        }
        std::thread::sleep(SLICE.min(left));
    }
}

/// # Safety
/// As `vkGetFenceStatus`.
unsafe extern "system" fn get_fence_status(handle: vk::Device, fence: vk::Fence) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        let data = device(handle);
        if arrive(&[Call::Status]).is_some_and(|f| f.kind == Kind::Lost) {
            return data.lose();
        }
        if data.is_lost() {
            return vk::Result::ERROR_DEVICE_LOST;
        }
        {
            let mut state = lock(&data.state);
            data.release_due(&mut state);
            if DeviceData::keeps_back(&state, fence) {
                return vk::Result::NOT_READY;
            }
        }
        (data.fns.get_fence_status)(handle, fence)
    }
}

/// # Safety
/// As `vkResetFences`.
unsafe extern "system" fn reset_fences(
    handle: vk::Device,
    count: u32,
    fences: *const vk::Fence,
) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        let data = device(handle);
        for fence in list(fences, count) {
            lock(&data.state).late.remove(&fence);
        }
        (data.fns.reset_fences)(handle, count, fences)
    }
}

/// # Safety
/// As `vkDeviceWaitIdle`.
unsafe extern "system" fn device_wait_idle(handle: vk::Device) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        let data = device(handle);
        data.wait_for_held().unwrap_or_else(|| (data.fns.device_wait_idle)(handle))
    }
}

/// # Safety
/// As `vkQueueWaitIdle`.
unsafe extern "system" fn queue_wait_idle(queue: vk::Queue) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        let data = device(queue);
        data.wait_for_held().unwrap_or_else(|| (data.fns.queue_wait_idle)(queue))
    }
}

/// # Safety
/// As `vkGetQueryPoolResults`.
unsafe extern "system" fn get_query_pool_results(
    handle: vk::Device,
    pool: vk::QueryPool,
    first: u32,
    count: u32,
    size: usize,
    out: *mut c_void,
    stride: vk::DeviceSize,
    flags: vk::QueryResultFlags,
) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        let data = device(handle);
        if data.is_lost() {
            return vk::Result::ERROR_DEVICE_LOST;
        }
        (data.fns.get_query_pool_results)(handle, pool, first, count, size, out, stride, flags)
    }
}

/// # Safety
/// As `vkGetDeviceQueue`.
unsafe extern "system" fn get_device_queue(handle: vk::Device, family: u32, index: u32, out: *mut vk::Queue) {
    // SAFETY: the caller's.
    unsafe {
        let data = device(handle);
        (data.fns.get_device_queue)(handle, family, index, out);
        lock(&data.state).families.insert(*out, family);
    }
}

/// # Safety
/// As `vkCmdDispatchIndirect`.
unsafe extern "system" fn cmd_dispatch_indirect(
    list: vk::CommandBuffer,
    arguments: vk::Buffer,
    offset: vk::DeviceSize,
) {
    // SAFETY: the caller's.
    unsafe {
        let data = device(list);
        lock(&data.state).frames.insert(list);
        (data.fns.cmd_dispatch_indirect)(list, arguments, offset);
    }
}

/// # Safety
/// As `vkCmdPipelineBarrier`.
unsafe extern "system" fn cmd_pipeline_barrier(
    list: vk::CommandBuffer,
    before: vk::PipelineStageFlags,
    after: vk::PipelineStageFlags,
    flags: vk::DependencyFlags,
    memory_count: u32,
    memory: *const vk::MemoryBarrier<'_>,
    buffer_count: u32,
    buffers: *const vk::BufferMemoryBarrier<'_>,
    image_count: u32,
    images: *const vk::ImageMemoryBarrier<'_>,
) {
    if arrive(&[Call::Barrier]).is_some() {
        return;
    }
    // SAFETY: the caller's.
    unsafe {
        (device(list).fns.cmd_pipeline_barrier)(
            list,
            before,
            after,
            flags,
            memory_count,
            memory,
            buffer_count,
            buffers,
            image_count,
            images,
        );
    }
}

/// # Safety
/// As `vkBeginCommandBuffer`.
unsafe extern "system" fn begin_command_buffer(
    list: vk::CommandBuffer,
    info: *const vk::CommandBufferBeginInfo<'_>,
) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        let data = device(list);
        if let Some(result) = failure(arrive(&[Call::Create])) {
            return result;
        }
        // The handle may be that of a list which is gone.
        lock(&data.state).frames.remove(&list);
        (data.fns.begin_command_buffer)(list, info)
    }
}

/// # Safety
/// As `vkCreateBuffer`.
unsafe extern "system" fn create_buffer(
    handle: vk::Device,
    info: *const vk::BufferCreateInfo<'_>,
    allocator: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::Buffer,
) -> vk::Result {
    // SAFETY: the caller's.
    unsafe {
        let data = device(handle);
        if let Some(result) = failure(arrive(&[Call::Buffer, Call::Create])) {
            return result;
        }
        let result = (data.fns.create_buffer)(handle, info, allocator, out);
        if result == vk::Result::SUCCESS {
            lock(&data.state).sizes.insert(*out, (*info).size);
        }
        result
    }
}

/// # Safety
/// As `vkCreateComputePipelines`.
unsafe extern "system" fn create_compute_pipelines(
    handle: vk::Device,
    cache: vk::PipelineCache,
    count: u32,
    infos: *const vk::ComputePipelineCreateInfo<'_>,
    allocator: *const vk::AllocationCallbacks<'_>,
    out: *mut vk::Pipeline,
) -> vk::Result {
    // SAFETY: the caller's; pipelines that could not be made are null.
    unsafe {
        let data = device(handle);
        if let Some(result) = failure(arrive(&[Call::Pipeline, Call::Create])) {
            for i in 0..count as usize {
                *out.add(i) = vk::Pipeline::null();
            }
            return result;
        }
        (data.fns.create_compute_pipelines)(handle, cache, count, infos, allocator, out)
    }
}

/// Calls that are counted, may fail, and are otherwise the driver's.
macro_rules! counted {
    ($($name:ident($first:ident: $object:ty $(, $arg:ident: $ty:ty)*) $calls:expr;)*) => {$(
        /// # Safety
        /// As Vulkan's function of this name.
        unsafe extern "system" fn $name($first: $object $(, $arg: $ty)*) -> vk::Result {
            // SAFETY: the caller's.
            unsafe {
                match failure(arrive($calls)) {
                    Some(result) => result,
                    None => (device($first).fns.$name)($first $(, $arg)*),
                }
            }
        }
    )*};
}

type Allocator<'a> = *const vk::AllocationCallbacks<'a>;

/// Calls that end an object of which the layer keeps something, and are otherwise the driver's.
macro_rules! forgotten {
    ($($name:ident($object:ty) $kept:ident;)*) => {$(
        /// # Safety
        /// As Vulkan's function of this name.
        unsafe extern "system" fn $name(handle: vk::Device, object: $object, allocator: Allocator<'_>) {
            // SAFETY: the caller's.
            unsafe {
                let data = device(handle);
                lock(&data.state).$kept.remove(&object);
                (data.fns.$name)(handle, object, allocator);
            }
        }
    )*};
}

forgotten! {
    destroy_fence(vk::Fence) late;
    destroy_buffer(vk::Buffer) sizes;
}

counted! {
    allocate_memory(d: vk::Device, info: *const vk::MemoryAllocateInfo<'_>, a: Allocator<'_>, out: *mut vk::DeviceMemory)
        &[Call::Memory, Call::Create];
    bind_buffer_memory(d: vk::Device, buffer: vk::Buffer, memory: vk::DeviceMemory, offset: vk::DeviceSize) &[Call::Create];
    map_memory(d: vk::Device, memory: vk::DeviceMemory, offset: vk::DeviceSize, size: vk::DeviceSize, flags: vk::MemoryMapFlags, out: *mut *mut c_void)
        &[Call::Create];
    create_buffer_view(d: vk::Device, info: *const vk::BufferViewCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::BufferView) &[Call::Create];
    create_shader_module(d: vk::Device, info: *const vk::ShaderModuleCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::ShaderModule) &[Call::Create];
    create_descriptor_set_layout(d: vk::Device, info: *const vk::DescriptorSetLayoutCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::DescriptorSetLayout)
        &[Call::Create];
    create_pipeline_layout(d: vk::Device, info: *const vk::PipelineLayoutCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::PipelineLayout) &[Call::Create];
    create_descriptor_pool(d: vk::Device, info: *const vk::DescriptorPoolCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::DescriptorPool) &[Call::Create];
    allocate_descriptor_sets(d: vk::Device, info: *const vk::DescriptorSetAllocateInfo<'_>, out: *mut vk::DescriptorSet) &[Call::Create];
    create_command_pool(d: vk::Device, info: *const vk::CommandPoolCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::CommandPool) &[Call::Create];
    allocate_command_buffers(d: vk::Device, info: *const vk::CommandBufferAllocateInfo<'_>, out: *mut vk::CommandBuffer) &[Call::Create];
    end_command_buffer(list: vk::CommandBuffer) &[Call::Create];
    create_query_pool(d: vk::Device, info: *const vk::QueryPoolCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::QueryPool) &[Call::Create];
    create_fence(d: vk::Device, info: *const vk::FenceCreateInfo<'_>, a: Allocator<'_>, out: *mut vk::Fence) &[Call::Create];
}

/// The layer's function of a name, for instances and devices alike.
fn own(name: &CStr) -> vk::PFN_vkVoidFunction {
    macro_rules! find {
        ($($vulkan:literal => $function:ident: $ty:ident,)*) => {
            match name.to_bytes() {
                $($vulkan => {
                    let function: vk::$ty = $function;
                    // SAFETY: callers cast it back to the type that the name says.
                    Some(unsafe { std::mem::transmute::<vk::$ty, unsafe extern "system" fn()>(function) })
                })*
                _ => None,
            }
        };
    }
    find! {
        b"vkGetInstanceProcAddr" => get_instance_proc_addr: PFN_vkGetInstanceProcAddr,
        b"vkGetDeviceProcAddr" => get_device_proc_addr: PFN_vkGetDeviceProcAddr,
        b"vkCreateInstance" => create_instance: PFN_vkCreateInstance,
        b"vkDestroyInstance" => destroy_instance: PFN_vkDestroyInstance,
        b"vkEnumeratePhysicalDevices" => enumerate_physical_devices: PFN_vkEnumeratePhysicalDevices,
        b"vkCreateDevice" => create_device: PFN_vkCreateDevice,
        b"vkDestroyDevice" => destroy_device: PFN_vkDestroyDevice,
        b"vkQueueSubmit" => queue_submit: PFN_vkQueueSubmit,
        b"vkWaitForFences" => wait_for_fences: PFN_vkWaitForFences,
        b"vkGetFenceStatus" => get_fence_status: PFN_vkGetFenceStatus,
        b"vkResetFences" => reset_fences: PFN_vkResetFences,
        b"vkDestroyFence" => destroy_fence: PFN_vkDestroyFence,
        b"vkDeviceWaitIdle" => device_wait_idle: PFN_vkDeviceWaitIdle,
        b"vkQueueWaitIdle" => queue_wait_idle: PFN_vkQueueWaitIdle,
        b"vkGetQueryPoolResults" => get_query_pool_results: PFN_vkGetQueryPoolResults,
        b"vkGetDeviceQueue" => get_device_queue: PFN_vkGetDeviceQueue,
        b"vkCmdDispatchIndirect" => cmd_dispatch_indirect: PFN_vkCmdDispatchIndirect,
        b"vkCmdPipelineBarrier" => cmd_pipeline_barrier: PFN_vkCmdPipelineBarrier,
        b"vkBeginCommandBuffer" => begin_command_buffer: PFN_vkBeginCommandBuffer,
        b"vkEndCommandBuffer" => end_command_buffer: PFN_vkEndCommandBuffer,
        b"vkCreateBuffer" => create_buffer: PFN_vkCreateBuffer,
        b"vkDestroyBuffer" => destroy_buffer: PFN_vkDestroyBuffer,
        b"vkCreateComputePipelines" => create_compute_pipelines: PFN_vkCreateComputePipelines,
        b"vkAllocateMemory" => allocate_memory: PFN_vkAllocateMemory,
        b"vkBindBufferMemory" => bind_buffer_memory: PFN_vkBindBufferMemory,
        b"vkMapMemory" => map_memory: PFN_vkMapMemory,
        b"vkCreateBufferView" => create_buffer_view: PFN_vkCreateBufferView,
        b"vkCreateShaderModule" => create_shader_module: PFN_vkCreateShaderModule,
        b"vkCreateDescriptorSetLayout" => create_descriptor_set_layout: PFN_vkCreateDescriptorSetLayout,
        b"vkCreatePipelineLayout" => create_pipeline_layout: PFN_vkCreatePipelineLayout,
        b"vkCreateDescriptorPool" => create_descriptor_pool: PFN_vkCreateDescriptorPool,
        b"vkAllocateDescriptorSets" => allocate_descriptor_sets: PFN_vkAllocateDescriptorSets,
        b"vkCreateCommandPool" => create_command_pool: PFN_vkCreateCommandPool,
        b"vkAllocateCommandBuffers" => allocate_command_buffers: PFN_vkAllocateCommandBuffers,
        b"vkCreateQueryPool" => create_query_pool: PFN_vkCreateQueryPool,
        b"vkCreateFence" => create_fence: PFN_vkCreateFence,
    }
}

/// Submissions of newer kinds, which this layer cannot hold back.
fn is_withheld(name: &CStr) -> bool {
    matches!(name.to_bytes(), b"vkQueueSubmit2" | b"vkQueueSubmit2KHR")
}

/// The loader's way to this layer's functions of an instance.
///
/// # Safety
/// As `vkGetInstanceProcAddr`.
pub(crate) unsafe extern "system" fn get_instance_proc_addr(
    handle: vk::Instance,
    name: *const c_char,
) -> vk::PFN_vkVoidFunction {
    // SAFETY: the caller's.
    unsafe {
        let text = CStr::from_ptr(name);
        if is_withheld(text) {
            return None;
        }
        own(text).or_else(|| {
            if handle.is_null() {
                return None;
            }
            (instance(handle).get_instance_proc_addr)(handle, name)
        })
    }
}

/// The loader's way to this layer's functions of a device.
///
/// # Safety
/// As `vkGetDeviceProcAddr`.
pub(crate) unsafe extern "system" fn get_device_proc_addr(
    handle: vk::Device,
    name: *const c_char,
) -> vk::PFN_vkVoidFunction {
    // SAFETY: the caller's.
    unsafe {
        let text = CStr::from_ptr(name);
        if is_withheld(text) {
            return None;
        }
        own(text).or_else(|| (device(handle).get_device_proc_addr)(handle, name))
    }
}
