//! Buffers: memory for shaders, mapped for the host where asked.

use super::context::{Gpu, On as _};
use super::error::{GpuError, MemoryPool};
use ash::vk;
use bytemuck::Pod;
use std::ptr::NonNull;
use std::sync::atomic::AtomicU32;
use std::sync::Arc;

/// Largest buffer of [`MemoryKind::Upload`] that goes to the GPU's own memory, bytes.
const MOST_UPLOAD_ON_DEVICE: u64 = 65_536;

/// The buffer has an address, and its memory too.
const ADDRESS: vk::BufferUsageFlags = vk::BufferUsageFlags::SHADER_DEVICE_ADDRESS;

/// Where a buffer lives and who touches it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MemoryKind {
    /// Read and written by shaders only. Filled once at creation.
    Device,
    /// Written by the host in every frame and read by shaders. Mapped for its whole life.
    Upload,
    /// Written by shaders and read by the host. Mapped, and cached if possible.
    Readback,
    /// Written and read by shaders and by threads of the host, in turns. Mapped, and cached if possible. What nobody has written is undefined, and takes
    /// no memory on software Vulkan.
    Shared,
}

/// Where a buffer's memory lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryPlace {
    /// In the GPU's own memory.
    pub on_device: bool,
    /// The host can write and read it.
    pub host_visible: bool,
    /// The host reads it through its caches.
    pub host_cached: bool,
}

/// A buffer with its own memory. Mapped kinds are coherent: no flushes.
pub struct Buffer {
    pub(super) handle: vk::Buffer,
    pub(super) view: Option<vk::BufferView>,
    memory: vk::DeviceMemory,
    mapped: Option<NonNull<u8>>,
    len_bytes: usize,
    /// What was allocated, alignment included.
    held_bytes: u64,
    properties: vk::MemoryPropertyFlags,
    gpu: Arc<Gpu>,
}

// SAFETY: the mapped pointer is owned by this buffer; Vulkan handles may move between threads. Access goes through &self / &mut self.
unsafe impl Send for Buffer {}
// SAFETY: shared access only reads.
unsafe impl Sync for Buffer {}

impl std::fmt::Debug for Buffer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Buffer({} bytes)", self.len_bytes)
    }
}

impl Buffer {
    /// An uninitialised buffer of at least one byte. `what` names it in errors.
    ///
    /// # Errors
    /// Out of memory, or larger than the device allows.
    pub fn new(gpu: &Arc<Gpu>, what: &str, len_bytes: usize, kind: MemoryKind) -> Result<Self, GpuError> {
        Self::with_usage(gpu, what, len_bytes, kind, vk::BufferUsageFlags::empty())
    }

    /// A device buffer filled with `data`.
    ///
    /// # Errors
    /// As [`Buffer::new`].
    pub fn from_slice<T: Pod>(gpu: &Arc<Gpu>, what: &str, data: &[T]) -> Result<Self, GpuError> {
        Self::filled(gpu, what, bytemuck::cast_slice(data), vk::BufferUsageFlags::empty())
    }

    /// A device buffer of 16-byte texels that shaders read as a texel buffer (`float`: RGBA32F, else RGBA32UI).
    ///
    /// # Errors
    /// As [`Buffer::new`]; [`GpuError::Limit`] when there are more texels than the device's texel buffers hold.
    pub(crate) fn texels(
        gpu: &Arc<Gpu>,
        what: &str,
        data: &[[u32; 4]],
        float: bool,
    ) -> Result<Self, GpuError> {
        Self::check_texels(gpu, what, data.len())?;
        Self::filled(gpu, what, bytemuck::cast_slice(data), vk::BufferUsageFlags::STORAGE_TEXEL_BUFFER)?
            .viewed_as_texels(float)
    }

    /// An uninitialised buffer of at least one 16-byte texel, read as [`Buffer::texels`] and written as storage.
    ///
    /// # Errors
    /// As [`Buffer::texels`]; [`GpuError::Limit`] when it is longer than the device's storage buffers, too.
    pub fn new_texels(
        gpu: &Arc<Gpu>,
        what: &str,
        texels: usize,
        float: bool,
        kind: MemoryKind,
    ) -> Result<Self, GpuError> {
        Self::check_texels(gpu, what, texels)?;
        Self::check_storage(gpu, what, texels * 16)?;
        Self::with_usage(gpu, what, texels * 16, kind, vk::BufferUsageFlags::STORAGE_TEXEL_BUFFER)?
            .viewed_as_texels(float)
    }

    fn check_texels(gpu: &Arc<Gpu>, what: &str, texels: usize) -> Result<(), GpuError> {
        let limit = gpu.max_texel_elements();
        if texels as u64 > limit {
            return Err(GpuError::Limit { what: format!("{what} (texels)"), needed: texels as u64, limit });
        }
        Ok(())
    }

    fn check_storage(gpu: &Arc<Gpu>, what: &str, len_bytes: usize) -> Result<(), GpuError> {
        let limit = u64::from(gpu.limits.max_storage_buffer_range);
        if len_bytes as u64 > limit {
            return Err(GpuError::Limit { what: format!("{what} (bytes)"), needed: len_bytes as u64, limit });
        }
        Ok(())
    }

    /// Adds the view through which shaders read it. The buffer has texel usage.
    fn viewed_as_texels(mut self, float: bool) -> Result<Self, GpuError> {
        let format = if float { vk::Format::R32G32B32A32_SFLOAT } else { vk::Format::R32G32B32A32_UINT };
        let info =
            vk::BufferViewCreateInfo::default().buffer(self.handle).format(format).range(vk::WHOLE_SIZE);
        // SAFETY: the buffer was created with texel usage and is alive.
        self.view = Some(
            unsafe { self.gpu.device.create_buffer_view(&info, None) }
                .on(&self.gpu, "creating a texel-buffer view")?,
        );
        Ok(self)
    }

    /// An uninitialised buffer with an address of its own, for what ray tracing reads and writes.
    ///
    /// # Errors
    /// As [`Buffer::new`], but storage buffers may be smaller.
    pub(super) fn addressed(
        gpu: &Arc<Gpu>,
        what: &str,
        len_bytes: u64,
        kind: MemoryKind,
        extra: vk::BufferUsageFlags,
    ) -> Result<Self, GpuError> {
        Self::with_usage(gpu, what, len_bytes as usize, kind, extra | ADDRESS)
    }

    /// A device buffer filled with bytes, with an address of its own.
    ///
    /// # Errors
    /// As [`Buffer::from_slice`].
    pub(super) fn filled_addressed(
        gpu: &Arc<Gpu>,
        what: &str,
        bytes: &[u8],
        extra: vk::BufferUsageFlags,
    ) -> Result<Self, GpuError> {
        Self::check_storage(gpu, what, bytes.len())?;
        Self::filled(gpu, what, bytes, extra | ADDRESS)
    }

    /// Where the device finds an addressed buffer.
    pub(super) fn address(&self) -> u64 {
        let info = vk::BufferDeviceAddressInfo::default().buffer(self.handle);
        // SAFETY: the buffer is alive and was made with this usage; only devices that were opened with the feature have such buffers.
        unsafe { self.gpu.device.get_buffer_device_address(&info) }
    }

    fn filled(
        gpu: &Arc<Gpu>,
        what: &str,
        bytes: &[u8],
        usage: vk::BufferUsageFlags,
    ) -> Result<Self, GpuError> {
        let buffer = Self::with_usage(gpu, what, bytes.len().max(16), MemoryKind::Device, usage)?;
        if !bytes.is_empty() {
            let mut staging = Self::new(gpu, "staging", bytes.len(), MemoryKind::Upload)?;
            staging.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
            super::commands::copy_now(gpu, &staging, &buffer, bytes.len())?;
        }
        Ok(buffer)
    }

    fn with_usage(
        gpu: &Arc<Gpu>,
        what: &str,
        len_bytes: usize,
        kind: MemoryKind,
        extra: vk::BufferUsageFlags,
    ) -> Result<Self, GpuError> {
        let len_bytes = len_bytes.max(16);
        if !extra.intersects(vk::BufferUsageFlags::STORAGE_TEXEL_BUFFER | ADDRESS) {
            Self::check_storage(gpu, what, len_bytes)?;
        }
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::UNIFORM_BUFFER
            | vk::BufferUsageFlags::INDIRECT_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST
            | extra;
        let info = vk::BufferCreateInfo::default().size(len_bytes as u64).usage(usage);
        gpu.alive("making a buffer")?;
        // SAFETY: valid create info; every handle made here is destroyed in Drop or on the error path below.
        unsafe {
            let handle = gpu.device.create_buffer(&info, None).on(gpu, "creating a buffer")?;
            let needs = gpu.device.get_buffer_memory_requirements(handle);
            let (memory, properties) =
                match gpu.takes(needs.size).and_then(|()| Self::allocate(gpu, what, needs, kind, extra)) {
                    Ok(memory) => memory,
                    Err(e) => {
                        gpu.device.destroy_buffer(handle, None);
                        return Err(e);
                    }
                };
            gpu.holds(needs.size, 0);
            let held_bytes = needs.size;
            let mut buffer = Self {
                handle,
                view: None,
                memory,
                mapped: None,
                len_bytes,
                held_bytes,
                properties,
                gpu: gpu.clone(),
            };
            gpu.device.bind_buffer_memory(handle, memory, 0).on(gpu, "binding buffer memory")?;
            if kind != MemoryKind::Device {
                let pointer = gpu
                    .device
                    .map_memory(memory, 0, vk::WHOLE_SIZE, vk::MemoryMapFlags::empty())
                    .on(gpu, "mapping a buffer")?;
                buffer.mapped = NonNull::new(pointer.cast());
                if kind != MemoryKind::Shared {
                    buffer.bytes_mut().fill(0);
                }
            }
            Ok(buffer)
        }
    }

    fn allocate(
        gpu: &Gpu,
        what: &str,
        needs: vk::MemoryRequirements,
        kind: MemoryKind,
        usage: vk::BufferUsageFlags,
    ) -> Result<(vk::DeviceMemory, vk::MemoryPropertyFlags), GpuError> {
        use vk::MemoryPropertyFlags as P;
        let coherent = P::HOST_VISIBLE | P::HOST_COHERENT;
        let on_device = coherent | P::DEVICE_LOCAL;
        let wishes: &[P] = match kind {
            MemoryKind::Device => &[P::DEVICE_LOCAL, P::empty()],
            // What a frame needs is small and goes to the GPU's own memory where the host can write to it. The rest goes to the host's, which the
            // GPU reads across the bus: that part of the GPU's memory may be small, too.
            MemoryKind::Upload if needs.size <= MOST_UPLOAD_ON_DEVICE => &[on_device, coherent],
            MemoryKind::Upload => &[coherent],
            MemoryKind::Readback | MemoryKind::Shared => &[
                P::from_raw(P::HOST_VISIBLE.as_raw() | P::HOST_COHERENT.as_raw() | P::HOST_CACHED.as_raw()),
                coherent,
            ],
        };
        let types = &gpu.memory.memory_types[..gpu.memory.memory_type_count as usize];
        let mut last = vk::Result::ERROR_OUT_OF_DEVICE_MEMORY;
        for &wish in wishes {
            for (i, t) in types.iter().enumerate() {
                if needs.memory_type_bits & (1 << i) == 0 || !t.property_flags.contains(wish) {
                    continue;
                }
                let mut addressed =
                    vk::MemoryAllocateFlagsInfo::default().flags(vk::MemoryAllocateFlags::DEVICE_ADDRESS);
                let mut info =
                    vk::MemoryAllocateInfo::default().allocation_size(needs.size).memory_type_index(i as u32);
                if usage.contains(ADDRESS) {
                    info = info.push_next(&mut addressed);
                }
                // SAFETY: valid allocate info; freed in Buffer's Drop.
                match unsafe { gpu.device.allocate_memory(&info, None) } {
                    Ok(memory) => return Ok((memory, t.property_flags)),
                    Err(e) => last = e,
                }
            }
        }
        let pool = match last {
            vk::Result::ERROR_OUT_OF_DEVICE_MEMORY => MemoryPool::Device,
            vk::Result::ERROR_OUT_OF_HOST_MEMORY => MemoryPool::Host,
            other => return Err(other).on(gpu, "allocating GPU memory"),
        };
        Err(GpuError::OutOfMemory {
            operation: format!("making the buffer of the {what}"),
            device: gpu.device_name().clone(),
            pool,
            needed_mib: Some(needs.size.div_ceil(1 << 20)),
            heap_mib: gpu.heap_mib(),
        })
    }

    /// Where its memory lies.
    pub fn place(&self) -> MemoryPlace {
        use vk::MemoryPropertyFlags as P;
        let has = |flag| self.properties.contains(flag);
        MemoryPlace {
            on_device: has(P::DEVICE_LOCAL),
            host_visible: has(P::HOST_VISIBLE),
            host_cached: has(P::HOST_CACHED),
        }
    }

    /// The mapped bytes. The GPU must not be writing them: wait for the frame's fence first.
    ///
    /// # Panics
    /// For [`MemoryKind::Device`] buffers, which are never mapped.
    pub(crate) fn bytes(&self) -> &[u8] {
        let pointer = self.mapped.expect("a mapped kind of buffer");
        // SAFETY: mapped for `len_bytes` for the life of the buffer.
        unsafe { std::slice::from_raw_parts(pointer.as_ptr(), self.len_bytes) }
    }

    /// The mapped bytes for writing. The GPU must not be using them.
    ///
    /// # Panics
    /// For [`MemoryKind::Device`] buffers.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        let pointer = self.mapped.expect("a mapped kind of buffer");
        // SAFETY: as above, and &mut self excludes other access by the host.
        unsafe { std::slice::from_raw_parts_mut(pointer.as_ptr(), self.len_bytes) }
    }

    /// The mapped words, for threads that share them: who may write which, and when, they agree on by other means.
    ///
    /// # Panics
    /// For [`MemoryKind::Device`] buffers.
    pub(crate) fn words(&self) -> &[AtomicU32] {
        let pointer = self.mapped.expect("a mapped kind of buffer");
        // SAFETY: mapped for `len_bytes` for the life of the buffer, and memory is mapped at whole pages. Words that are read while the device writes
        // them may be any; nobody relies on those.
        unsafe { std::slice::from_raw_parts(pointer.as_ptr().cast::<AtomicU32>(), self.len_bytes / 4) }
    }

    /// The first `count` elements.
    pub fn read<T: Pod>(&self, count: usize) -> &[T] {
        bytemuck::cast_slice(&self.bytes()[..count * std::mem::size_of::<T>()])
    }

    /// Copies `data` to the start.
    pub(crate) fn write<T: Pod>(&mut self, data: &[T]) {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        self.bytes_mut()[..bytes.len()].copy_from_slice(bytes);
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        let (view, handle, memory, bytes) = (self.view, self.handle, self.memory, self.held_bytes);
        self.gpu.destroy(move |gpu| {
            // SAFETY: owners wait for the GPU before dropping (FrameFence does in its Drop), or the device is lost; handles are ours alone.
            unsafe {
                if let Some(view) = view {
                    gpu.device.destroy_buffer_view(view, None);
                }
                gpu.device.destroy_buffer(handle, None);
                gpu.device.free_memory(memory, None);
            }
            gpu.freed(bytes);
        });
    }
}
