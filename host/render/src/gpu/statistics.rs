//! What the driver's compiler made of a pipeline: registers, spills, size (`VK_KHR_pipeline_executable_properties`).

use super::context::On as _;
use super::error::GpuError;
use super::pipeline::ComputePipeline;
use ash::vk;
use std::ffi::CStr;

/// One program that the driver made of a pipeline. Most drivers make one of a compute shader, some make one for each subgroup size.
#[derive(Clone, Debug, PartialEq)]
pub struct Executable {
    /// The driver's name for it.
    pub name: String,
    /// Lanes of a subgroup; 0: the driver does not say.
    pub subgroup_size: u32,
    /// What the driver counted, by its own names.
    pub statistics: Vec<(String, f64)>,
}

impl Executable {
    /// The statistic of this name.
    pub fn get(&self, name: &str) -> Option<f64> {
        self.statistics.iter().find(|(known, _)| known == name).map(|(_, value)| *value)
    }
}

fn text(bytes: Result<&CStr, std::ffi::FromBytesUntilNulError>) -> String {
    bytes.map(|text| text.to_string_lossy().into_owned()).unwrap_or_default()
}

fn value_of(statistic: &vk::PipelineExecutableStatisticKHR<'_>) -> f64 {
    use vk::PipelineExecutableStatisticFormatKHR as Format;
    // SAFETY: the format says which member of the union the driver wrote.
    unsafe {
        match statistic.format {
            Format::BOOL32 => f64::from(statistic.value.b32),
            Format::INT64 => statistic.value.i64 as f64,
            Format::UINT64 => statistic.value.u64 as f64,
            _ => statistic.value.f64,
        }
    }
}

impl ComputePipeline {
    /// The programs that the driver made of it. Empty unless the device was opened with [`super::GpuOptions::statistics`].
    ///
    /// # Errors
    /// A call of Vulkan failed.
    pub fn executables(&self) -> Result<Vec<Executable>, GpuError> {
        const OPERATION: &str = "asking what became of a pipeline";
        let gpu = &self.table.gpu;
        let Some(calls) = &gpu.statistics else {
            return Ok(Vec::new());
        };
        gpu.alive(OPERATION)?;
        let info = vk::PipelineInfoKHR::default().pipeline(self.pipeline);
        // SAFETY: the pipeline is alive and was made to keep its statistics.
        let programs = unsafe { calls.get_pipeline_executable_properties(&info) }.on(gpu, OPERATION)?;
        (0u32..)
            .zip(programs)
            .map(|(index, program)| {
                let info =
                    vk::PipelineExecutableInfoKHR::default().pipeline(self.pipeline).executable_index(index);
                // SAFETY: as above, and the driver has named this many programs.
                let statistics =
                    unsafe { calls.get_pipeline_executable_statistics(&info) }.on(gpu, OPERATION)?;
                Ok(Executable {
                    name: text(program.name_as_c_str()),
                    subgroup_size: program.subgroup_size,
                    statistics: statistics.iter().map(|s| (text(s.name_as_c_str()), value_of(s))).collect(),
                })
            })
            .collect()
    }
}
