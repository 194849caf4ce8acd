//! The devices that the loader lists: what each can do, why one cannot be used, and which comes first.

use super::error::GpuError;
use super::pipeline::{shared_bindings, BindingKind};
use super::GpuOptions;
use ash::{amd, ext, khr, nv, vk};
use dpm_shaders::Reading;
use std::ffi::CStr;
use std::time::Duration;

/// A device as `dpm doctor` lists it.
#[derive(Clone, Debug)]
pub struct DeviceSummary {
    /// The driver's name for it.
    pub name: String,
    /// Driver name and version text.
    pub driver: String,
    /// Vulkan version.
    pub api_version: String,
    /// Runs on the CPU.
    pub software: bool,
    /// Why dpm cannot use it, if so.
    pub refused: Option<String>,
    /// What is known to be slow about its driver, and what to do.
    pub advice: Option<String>,
    /// It can find itself what a ray meets (ray query).
    pub ray_query: bool,
    /// Device-local memory in MiB.
    pub memory_mib: u64,
    /// Nanoseconds per time-stamp tick; 0: no time stamps.
    pub timestamp_period_ns: f32,
    /// Lanes in a subgroup.
    pub subgroup_size: u32,
    /// Multiprocessors (NVIDIA) or compute units (AMD); `None`: the driver does not say.
    pub processors: Option<u32>,
    /// Frames go to a queue that does not draw, so they do not share its time with a desktop.
    pub own_queue: bool,
}

impl DeviceSummary {
    /// How long it has to draw until it has raised its clock. A GPU that has been idle for some seconds runs at a fraction of it (an H100 at 345 of
    /// 1980 MHz) and needs up to half a second of work.
    pub fn wakes_within(&self) -> Duration {
        if self.software {
            Duration::ZERO
        } else {
            Duration::from_millis(700)
        }
    }
}

/// Identifies a device in several lists of the same machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct DeviceId {
    uuid: [u8; vk::UUID_SIZE],
    pub(super) name: String,
    /// Several devices may agree in all of this (software Vulkan). This is the place among them, in the order of the list.
    twin: usize,
}

/// A device of the loader's list.
pub(super) struct Candidate {
    pub physical: vk::PhysicalDevice,
    pub summary: DeviceSummary,
    pub id: DeviceId,
}

/// What the shaders and the renderer ask of a device.
#[derive(Clone, Copy, Debug)]
struct Abilities {
    api_version: u32,
    scalar_block_layout: bool,
    /// Atomic operations on numbers of 64 bits.
    atomics_of_64_bits: bool,
    compute_queue: bool,
    /// Storage buffers that one shader can be given.
    storage_buffers: u32,
    /// Texel buffers, which count as storage images.
    storage_images: u32,
    /// Bindings of all kinds together.
    resources: u32,
    /// Lanes of a workgroup.
    invocations: u32,
    /// Memory that a workgroup shares, bytes.
    shared_bytes: u32,
    /// In compute shaders; empty where those have none.
    subgroup_operations: vk::SubgroupFeatureFlags,
    /// The driver can say what its compiler made of a pipeline.
    statistics: bool,
    /// Size of the largest heap of the device's own memory.
    memory_bytes: u64,
}

/// Subgroup operations of the shaders.
const SUBGROUP_OPERATIONS: vk::SubgroupFeatureFlags = vk::SubgroupFeatureFlags::from_raw(
    vk::SubgroupFeatureFlags::BASIC.as_raw()
        | vk::SubgroupFeatureFlags::ARITHMETIC.as_raw()
        | vk::SubgroupFeatureFlags::BALLOT.as_raw(),
);
/// Lanes of the largest workgroup.
const INVOCATIONS: u32 = 64;
/// Shared memory of the walk in the deepest tree, and some more, bytes. Every device must have this much by the standard.
const SHARED_BYTES: u32 = 16_384;

fn version_text(v: u32) -> String {
    format!("{}.{}.{}", vk::api_version_major(v), vk::api_version_minor(v), vk::api_version_patch(v))
}

/// The bindings that every device must have: those of the shaders' own walk.
fn bindings_of(software: bool) -> Vec<(u32, BindingKind)> {
    shared_bindings(if software { Reading::Texels } else { Reading::Storage }, false)
}

impl Abilities {
    fn of(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Self {
        let mut scalar = vk::PhysicalDeviceScalarBlockLayoutFeatures::default();
        let mut atomics = vk::PhysicalDeviceShaderAtomicInt64Features::default();
        let mut features =
            vk::PhysicalDeviceFeatures2::default().push_next(&mut scalar).push_next(&mut atomics);
        let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
        let mut props = vk::PhysicalDeviceProperties2::default().push_next(&mut subgroup);
        // SAFETY: `features` and `props` chain valid structures.
        unsafe {
            instance.get_physical_device_features2(physical, &mut features);
            instance.get_physical_device_properties2(physical, &mut props);
        }
        let base = props.properties;
        let has_64_bits = features.features.shader_int64 != 0;
        let in_compute = subgroup.supported_stages.contains(vk::ShaderStageFlags::COMPUTE);
        Self {
            api_version: base.api_version,
            scalar_block_layout: scalar.scalar_block_layout != 0,
            atomics_of_64_bits: has_64_bits && atomics.shader_buffer_int64_atomics != 0,
            compute_queue: compute_family(instance, physical).is_some(),
            storage_buffers: (base.limits.max_per_stage_descriptor_storage_buffers)
                .min(base.limits.max_descriptor_set_storage_buffers),
            storage_images: (base.limits.max_per_stage_descriptor_storage_images)
                .min(base.limits.max_descriptor_set_storage_images),
            resources: base.limits.max_per_stage_resources,
            invocations: base.limits.max_compute_work_group_invocations,
            shared_bytes: base.limits.max_compute_shared_memory_size,
            subgroup_operations: if in_compute {
                subgroup.supported_operations
            } else {
                vk::SubgroupFeatureFlags::empty()
            },
            statistics: has_extension(instance, physical, khr::pipeline_executable_properties::NAME),
            memory_bytes: own_memory(instance, physical),
        }
    }

    /// Why a device with these abilities cannot be used as the options want it; `software`: it runs on the CPU, with tables in texel buffers.
    fn lacks(&self, software: bool, options: &GpuOptions) -> Option<String> {
        let mut missing = Vec::new();
        if self.api_version < vk::make_api_version(0, 1, 2, 0) {
            missing.push(format!("Vulkan 1.2 (has {})", version_text(self.api_version)));
        }
        if !self.scalar_block_layout {
            missing.push("scalarBlockLayout".to_owned());
        }
        if !self.atomics_of_64_bits {
            missing.push("shaderInt64 with shaderBufferInt64Atomics".to_owned());
        }
        if !self.compute_queue {
            missing.push("a compute queue".to_owned());
        }
        let bindings = bindings_of(software);
        let bound = |kind| bindings.iter().filter(|b| b.1 == kind).count() as u32;
        let mut at_least = |what: &str, due: u32, has: u32| {
            if has < due {
                missing.push(format!("{what} (has {has}, needs {due})"));
            }
        };
        at_least("storage buffers of a shader", bound(BindingKind::Storage), self.storage_buffers);
        at_least("texel buffers of a shader", bound(BindingKind::Texel), self.storage_images);
        at_least("resources of a shader", bindings.len() as u32, self.resources);
        at_least("invocations of a workgroup", INVOCATIONS, self.invocations);
        at_least("bytes of shared memory", SHARED_BYTES, self.shared_bytes);
        let operations = SUBGROUP_OPERATIONS & !self.subgroup_operations;
        if !operations.is_empty() {
            missing.push(format!("subgroup operations in compute shaders: {operations:?}"));
        }
        if !software && self.memory_bytes < options.memory_bytes {
            let mib = |bytes: u64| bytes.div_ceil(1 << 20);
            let (has, due) = (mib(self.memory_bytes), mib(options.memory_bytes));
            missing.push(format!("memory for the frames (has {has} MiB, needs {due} MiB)"));
        }
        if options.statistics && !self.statistics {
            missing.push("VK_KHR_pipeline_executable_properties".to_owned());
        }
        (!missing.is_empty()).then(|| format!("lacks {}", missing.join(", ")))
    }
}

fn has_extension(instance: &ash::Instance, physical: vk::PhysicalDevice, name: &CStr) -> bool {
    // SAFETY: plain query.
    let all = unsafe { instance.enumerate_device_extension_properties(physical) }.unwrap_or_default();
    all.iter().any(|e| e.extension_name_as_c_str() == Ok(name))
}

/// The extensions that a device is opened with if it can find itself what a ray meets.
pub(super) const RAY_QUERY: [&CStr; 3] =
    [khr::acceleration_structure::NAME, khr::ray_query::NAME, khr::deferred_host_operations::NAME];

/// Whether a device has ray queries, with all that they need.
fn has_ray_queries(instance: &ash::Instance, physical: vk::PhysicalDevice) -> bool {
    let mut trees = vk::PhysicalDeviceAccelerationStructureFeaturesKHR::default();
    let mut queries = vk::PhysicalDeviceRayQueryFeaturesKHR::default();
    let mut addresses = vk::PhysicalDeviceBufferDeviceAddressFeatures::default();
    if !RAY_QUERY.iter().all(|name| has_extension(instance, physical, name)) {
        return false;
    }
    let mut features = vk::PhysicalDeviceFeatures2::default()
        .push_next(&mut trees)
        .push_next(&mut queries)
        .push_next(&mut addresses);
    // SAFETY: `features` chains valid structures, of extensions that the device has.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    let all = [trees.acceleration_structure, queries.ray_query, addresses.buffer_device_address];
    all.iter().all(|&has| has != 0)
}

/// At which multiples of an address trees may be built, bytes.
pub(super) fn scratch_alignment(instance: &ash::Instance, physical: vk::PhysicalDevice) -> u64 {
    let mut trees = vk::PhysicalDeviceAccelerationStructurePropertiesKHR::default();
    let mut props = vk::PhysicalDeviceProperties2::default().push_next(&mut trees);
    // SAFETY: `props` chains a valid structure, of an extension that the device has.
    unsafe { instance.get_physical_device_properties2(physical, &mut props) };
    u64::from(trees.min_acceleration_structure_scratch_offset_alignment).max(1)
}

/// Size of the largest heap of the device's own memory, bytes.
fn own_memory(instance: &ash::Instance, physical: vk::PhysicalDevice) -> u64 {
    // SAFETY: plain query.
    let memory = unsafe { instance.get_physical_device_memory_properties(physical) };
    let heaps = &memory.memory_heaps[..memory.memory_heap_count as usize];
    let own = heaps.iter().filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
    own.map(|h| h.size).max().unwrap_or(0)
}

/// How many multiprocessors or compute units there are, if the driver says so in its maker's way.
fn processors(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<u32> {
    let mut nvidia = vk::PhysicalDeviceShaderSMBuiltinsPropertiesNV::default();
    let mut amd = vk::PhysicalDeviceShaderCorePropertiesAMD::default();
    let (has_nvidia, has_amd) = (
        has_extension(instance, physical, nv::shader_sm_builtins::NAME),
        has_extension(instance, physical, amd::shader_core_properties::NAME),
    );
    let mut props = vk::PhysicalDeviceProperties2::default();
    if has_nvidia {
        props = props.push_next(&mut nvidia);
    }
    if has_amd {
        props = props.push_next(&mut amd);
    }
    // SAFETY: `props` chains valid structures, of extensions that the device has.
    unsafe { instance.get_physical_device_properties2(physical, &mut props) };
    let units =
        amd.shader_engine_count * amd.shader_arrays_per_engine_count * amd.compute_units_per_shader_array;
    Some(nvidia.shader_sm_count.max(units)).filter(|&n| n > 0)
}

/// The first Mesa whose driver for AMD's GPUs was seen to compile every pass without spilling a register (docs/lab/GPU.md).
const GOOD_RADV: u32 = 25;

/// What is known to be slow about a driver, and what to do.
fn advice_on(driver: vk::DriverId, version: u32) -> Option<String> {
    let (major, minor) = (vk::api_version_major(version), vk::api_version_minor(version));
    (driver == vk::DriverId::MESA_RADV && major < GOOD_RADV).then(|| {
        format!(
            "its compiler is old (Mesa {major}.{minor}) and keeps hundreds of the tracer's registers in memory, which makes frames several times as \
             slow: install Mesa {GOOD_RADV} or newer (Debian 12: apt-get install -t bookworm-backports mesa-vulkan-drivers)"
        )
    })
}

/// The family of queues that frames are submitted to.
pub(super) fn compute_family(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<u32> {
    // SAFETY: plain query.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    let compute = |f: &vk::QueueFamilyProperties| f.queue_flags.contains(vk::QueueFlags::COMPUTE);
    // A queue family without graphics does not share its time with a desktop.
    families
        .iter()
        .position(|f| {
            compute(f) && !f.queue_flags.contains(vk::QueueFlags::GRAPHICS) && f.timestamp_valid_bits > 0
        })
        .or_else(|| families.iter().position(compute))
        .map(|i| i as u32)
}

/// The extension by which queues go before those of other programs, if the device has it.
pub(super) fn has_priorities(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
) -> Option<&'static CStr> {
    let names = [khr::global_priority::NAME, ext::global_priority::NAME];
    names.into_iter().find(|name| has_extension(instance, physical, name))
}

/// Whether the device has semaphores that count. The standard asks it of every device of Vulkan 1.2.
pub(super) fn has_timelines(instance: &ash::Instance, physical: vk::PhysicalDevice) -> bool {
    let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut vulkan12);
    // SAFETY: `features` chains a valid structure.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    vulkan12.timeline_semaphore != 0
}

/// Queues of this family that frames use: two if there are, so that the end of one frame and the beginning of the next share the device.
pub(super) fn queue_count(instance: &ash::Instance, physical: vk::PhysicalDevice, family: u32) -> u32 {
    // SAFETY: plain query.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    families.get(family as usize).map_or(1, |f| f.queue_count.clamp(1, 2))
}

/// Whether queues of this family draw.
fn draws(instance: &ash::Instance, physical: vk::PhysicalDevice, family: u32) -> bool {
    // SAFETY: plain query.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    families.get(family as usize).is_some_and(|f| f.queue_flags.contains(vk::QueueFlags::GRAPHICS))
}

/// Describes a device, with its identity.
fn summarise(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    options: &GpuOptions,
) -> (DeviceSummary, [u8; vk::UUID_SIZE]) {
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
    let mut id = vk::PhysicalDeviceIDProperties::default();
    let mut props = vk::PhysicalDeviceProperties2::default()
        .push_next(&mut driver)
        .push_next(&mut subgroup)
        .push_next(&mut id);
    // SAFETY: `props` chains valid structures.
    unsafe { instance.get_physical_device_properties2(physical, &mut props) };
    let base = props.properties;
    let text = |r: Result<&CStr, _>| r.map(|c: &CStr| c.to_string_lossy().into_owned()).unwrap_or_default();
    let software = base.device_type == vk::PhysicalDeviceType::CPU;
    let summary = DeviceSummary {
        name: text(base.device_name_as_c_str().map_err(|_| ())),
        driver: format!(
            "{} {}",
            text(driver.driver_name_as_c_str().map_err(|_| ())),
            text(driver.driver_info_as_c_str().map_err(|_| ()))
        ),
        api_version: version_text(base.api_version),
        software,
        refused: Abilities::of(instance, physical).lacks(software, options),
        advice: advice_on(driver.driver_id, base.driver_version),
        ray_query: has_ray_queries(instance, physical),
        memory_mib: own_memory(instance, physical) >> 20,
        timestamp_period_ns: if base.limits.timestamp_compute_and_graphics != 0 {
            base.limits.timestamp_period
        } else {
            0.0
        },
        subgroup_size: subgroup.subgroup_size,
        processors: processors(instance, physical),
        own_queue: compute_family(instance, physical)
            .is_some_and(|family| !draws(instance, physical, family)),
    };
    (summary, id.device_uuid)
}

/// The loader's list, with what keeps each device from being used as the options want it.
pub(super) fn candidates(instance: &ash::Instance, options: &GpuOptions) -> Result<Vec<Candidate>, GpuError> {
    // SAFETY: plain enumeration.
    let all = unsafe { instance.enumerate_physical_devices() }
        .map_err(GpuError::without_device("listing Vulkan devices"))?;
    let mut found: Vec<Candidate> = Vec::with_capacity(all.len());
    for physical in all {
        let (summary, uuid) = summarise(instance, physical, options);
        let same = |c: &&Candidate| (c.id.uuid, &c.id.name) == (uuid, &summary.name);
        let twin = found.iter().filter(same).count();
        let id = DeviceId { uuid, name: summary.name.clone(), twin };
        found.push(Candidate { physical, summary, id });
    }
    Ok(found)
}

/// Whether the options allow a device.
fn allows(options: &GpuOptions, summary: &DeviceSummary) -> bool {
    summary.refused.is_none()
        && options.device.as_ref().is_none_or(|wish| summary.name.contains(wish.as_str()))
}

/// The devices that the options allow, best first: discrete before integrated before virtual before software.
pub(super) fn usable(
    instance: &ash::Instance,
    mut all: Vec<Candidate>,
    options: &GpuOptions,
) -> Vec<Candidate> {
    all.retain(|c| allows(options, &c.summary));
    all.sort_by_key(|c| {
        // SAFETY: plain query.
        match unsafe { instance.get_physical_device_properties(c.physical) }.device_type {
            vk::PhysicalDeviceType::DISCRETE_GPU => 0,
            vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
            vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
            _ => 3,
        }
    });
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A device that has just what is needed, by the shaders' own tables.
    fn able(software: bool) -> Abilities {
        let bindings = bindings_of(software);
        let bound = |kind| bindings.iter().filter(|b| b.1 == kind).count() as u32;
        Abilities {
            api_version: vk::make_api_version(0, 1, 2, 0),
            scalar_block_layout: true,
            atomics_of_64_bits: true,
            compute_queue: true,
            storage_buffers: bound(BindingKind::Storage),
            storage_images: bound(BindingKind::Texel),
            resources: bindings.len() as u32,
            invocations: INVOCATIONS,
            shared_bytes: SHARED_BYTES,
            subgroup_operations: SUBGROUP_OPERATIONS,
            statistics: false,
            memory_bytes: 3 << 20,
        }
    }

    #[test]
    fn a_device_that_has_just_what_is_needed_is_taken_and_one_less_of_anything_is_refused_by_name() {
        let plain = GpuOptions::default();
        for software in [false, true] {
            let able = able(software);
            assert_eq!(able.lacks(software, &plain), None);
            let mut less: Vec<(&str, Abilities)> = vec![
                (
                    "Vulkan 1.2 (has 1.1.0)",
                    Abilities { api_version: vk::make_api_version(0, 1, 1, 0), ..able },
                ),
                ("scalarBlockLayout", Abilities { scalar_block_layout: false, ..able }),
                ("shaderBufferInt64Atomics", Abilities { atomics_of_64_bits: false, ..able }),
                ("a compute queue", Abilities { compute_queue: false, ..able }),
                ("storage buffers", Abilities { storage_buffers: able.storage_buffers - 1, ..able }),
                ("resources", Abilities { resources: able.resources - 1, ..able }),
                ("invocations", Abilities { invocations: INVOCATIONS - 1, ..able }),
                ("shared memory", Abilities { shared_bytes: SHARED_BYTES - 1, ..able }),
                ("ARITHMETIC", Abilities { subgroup_operations: vk::SubgroupFeatureFlags::BASIC, ..able }),
            ];
            if software {
                less.push(("texel buffers", Abilities { storage_images: able.storage_images - 1, ..able }));
            }
            for (name, abilities) in less {
                let reason =
                    abilities.lacks(software, &plain).unwrap_or_else(|| panic!("{name} is not asked for"));
                assert!(reason.contains(name), "{name}: {reason}");
            }
            let wishes = GpuOptions { statistics: true, ..plain.clone() };
            assert!(able.lacks(software, &wishes).is_some_and(|r| r.contains("executable")));
            // Software Vulkan uses the machine's memory.
            let wishes = GpuOptions { memory_bytes: (3 << 20) + 1, ..GpuOptions::default() };
            let reason = able.lacks(software, &wishes).unwrap_or_default();
            assert_eq!(reason.contains("has 3 MiB, needs 4 MiB"), !software, "{reason}");
        }
    }

    /// A Raspberry Pi 5, as Mesa 25.0 describes it: it comes before software Vulkan, and cannot run the shaders.
    #[test]
    fn a_raspberry_pi_is_refused_with_both_reasons() {
        let pi = Abilities {
            storage_buffers: 8,
            subgroup_operations: SUBGROUP_OPERATIONS & !vk::SubgroupFeatureFlags::ARITHMETIC,
            ..able(false)
        };
        let reason = pi.lacks(false, &GpuOptions::default()).expect("it is refused");
        let due = able(false).storage_buffers;
        assert!(due > 8, "{due}");
        for part in [&format!("storage buffers of a shader (has 8, needs {due})"), "ARITHMETIC"] {
            assert!(reason.contains(part), "{part}: {reason}");
        }
        assert!(!reason.contains("BALLOT"), "{reason}");
    }

    /// What is asked for is what the SPIR-V declares, no more and no less.
    #[test]
    fn the_subgroup_operations_and_workgroups_are_those_of_the_shaders() {
        let (mut operations, mut largest) = (vk::SubgroupFeatureFlags::empty(), 0);
        let mut features = std::collections::BTreeSet::new();
        for shader in dpm_shaders::ALL {
            let word = |c: &[u8]| u32::from_le_bytes([c[0], c[1], c[2], c[3]]);
            let words: Vec<u32> = shader.spirv.chunks_exact(4).map(word).collect();
            let mut at = 5;
            while at < words.len() {
                let (length, op) = ((words[at] >> 16) as usize, words[at] & 0xffff);
                match (op, words.get(at + 1), words.get(at + 2)) {
                    // OpCapability of a kind of GroupNonUniform.
                    (17, Some(61), _) => operations |= vk::SubgroupFeatureFlags::BASIC,
                    (17, Some(62), _) => operations |= vk::SubgroupFeatureFlags::VOTE,
                    (17, Some(63), _) => operations |= vk::SubgroupFeatureFlags::ARITHMETIC,
                    (17, Some(64), _) => operations |= vk::SubgroupFeatureFlags::BALLOT,
                    (17, Some(65), _) => operations |= vk::SubgroupFeatureFlags::SHUFFLE,
                    (17, Some(66), _) => operations |= vk::SubgroupFeatureFlags::SHUFFLE_RELATIVE,
                    (17, Some(67), _) => operations |= vk::SubgroupFeatureFlags::CLUSTERED,
                    (17, Some(68), _) => operations |= vk::SubgroupFeatureFlags::QUAD,
                    (17, Some(capability), _) => drop(features.insert(*capability)),
                    // OpExecutionMode LocalSize.
                    (16, _, Some(17)) => largest = largest.max(words[at + 3..at + 6].iter().product()),
                    _ => {}
                }
                at += length;
            }
        }
        assert_eq!((operations, largest), (SUBGROUP_OPERATIONS, INVOCATIONS));
        // Shader, Int64, Int64Atomics and ImageBuffer; and RayQueryKHR, which only devices that have it are given.
        assert_eq!(features, [1, 11, 12, 47, 4472].into());
    }

    #[test]
    fn old_drivers_are_named_with_what_to_install() {
        let mesa = |major, minor| vk::make_api_version(0, major, minor, 6);
        let old = advice_on(vk::DriverId::MESA_RADV, mesa(22, 3)).expect("it spills");
        assert!(old.contains("Mesa 22.3") && old.contains("backports"), "{old}");
        assert_eq!(advice_on(vk::DriverId::MESA_RADV, mesa(25, 0)), None);
        assert_eq!(advice_on(vk::DriverId::NVIDIA_PROPRIETARY, mesa(5, 0)), None);
    }
}
