//! The GPUs and drivers that the shaders are compiled for, and how a driver is made to believe that its GPU is there.

use std::path::{Path, PathBuf};
use std::process::Command;

/// A GPU with a driver.
#[derive(Debug)]
pub struct Target {
    /// Name in tables: the GPU and the driver with its Mesa.
    pub name: &'static str,
    /// What it is, for readers.
    pub gpu: &'static str,
    /// Folder of the driver's Debian release, as `drivers` makes it.
    pub release: &'static str,
    /// The driver's file.
    driver: &'static str,
    /// A library that plays the kernel's driver; empty: the driver needs none.
    shim: &'static str,
    environment: &'static [(&'static str, &'static str)],
    /// `false`: an old driver, which is compiled for to know what it does to users who have it.
    pub current: bool,
    /// The maker of the GPU.
    pub maker: Maker,
    /// The driver has ray query.
    pub ray_query: bool,
}

/// Who made a GPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Maker {
    /// AMD, with Mesa's driver RADV.
    Amd,
    /// NVIDIA, with Mesa's driver NVK. NVIDIA's own driver has another compiler.
    Nvidia,
    /// Nobody: Mesa's driver runs on the CPU.
    Software,
}

const RADV: &str = "libvulkan_radeon.so";
const NVK: &str = "libvulkan_nouveau.so";
const NOUVEAU_SHIM: &str = "libnouveau_noop_drm_shim.so";

/// Every target, in the order of the table.
pub const ALL: &[Target] = &[
    amd("navi21, RADV 25.0", "RDNA2 (RX 6800)", "backports", &[("RADV_FORCE_FAMILY", "navi21")], true),
    amd("navi31, RADV 25.0", "RDNA3 (RX 7900)", "backports", &[("RADV_FORCE_FAMILY", "navi31")], true),
    amd("gfx1201, RADV 25.0", "RDNA4 (RX 9070)", "backports", &[("RADV_FORCE_FAMILY", "gfx1201")], true),
    amd("navi21, RADV 22.3", "RDNA2 on Debian 12", "bookworm", &[("RADV_FORCE_FAMILY", "navi21")], false),
    amd("navi31, RADV 22.3", "RDNA3 on Debian 12", "bookworm", &[("RADV_FORCE_FAMILY", "gfx1100")], false),
    nvidia("tu102, NVK 25.0", "Turing (RTX 2080 Ti)", &[("NOUVEAU_CHIPSET", "162")]),
    nvidia("ga102, NVK 25.0", "Ampere (RTX 3080)", &[("NOUVEAU_CHIPSET", "172")]),
];

/// The driver over a kernel that does nothing, for rehearsals: nothing is drawn, but everything that the host does is real.
pub const DRY_RUN: Target = Target {
    name: "navi21, no-op kernel",
    gpu: "RDNA2 (RX 6800)",
    release: "backports",
    driver: RADV,
    shim: "libamdgpu_noop_drm_shim.so",
    environment: &[("AMDGPU_GPU_ID", "navi21")],
    current: true,
    maker: Maker::Amd,
    ray_query: true,
};

/// Software Vulkan that has ray query, which that of Debian 12 has not. It draws.
pub const SOFTWARE: Target = Target {
    name: "llvmpipe, Mesa 25.0",
    gpu: "software Vulkan",
    release: "backports",
    driver: "libvulkan_lvp.so",
    shim: "",
    environment: &[],
    current: true,
    maker: Maker::Software,
    ray_query: true,
};

type Environment = &'static [(&'static str, &'static str)];

const fn amd(
    name: &'static str,
    gpu: &'static str,
    release: &'static str,
    environment: Environment,
    current: bool,
) -> Target {
    Target {
        name,
        gpu,
        release,
        driver: RADV,
        shim: "",
        environment,
        current,
        maker: Maker::Amd,
        ray_query: true,
    }
}

const fn nvidia(name: &'static str, gpu: &'static str, environment: Environment) -> Target {
    Target {
        name,
        gpu,
        release: "trixie",
        driver: NVK,
        shim: NOUVEAU_SHIM,
        environment,
        current: true,
        maker: Maker::Nvidia,
        ray_query: false,
    }
}

impl Target {
    /// The target of this name.
    pub fn named(name: &str) -> Option<&'static Self> {
        ALL.iter().find(|target| target.name == name)
    }

    /// A command that runs `program` with this target's driver and with the libraries of its release, whatever the system has. `scratch` is a
    /// folder for the driver's manifest.
    ///
    /// # Errors
    /// The driver is not where `drivers` puts it, or the manifest cannot be written.
    pub fn command(&self, drivers: &Path, program: &Path, scratch: &Path) -> Result<Command, String> {
        let release = drivers.join(self.release);
        let libraries: Vec<PathBuf> = ["usr/lib/x86_64-linux-gnu", "lib/x86_64-linux-gnu"]
            .iter()
            .map(|folder| release.join(folder))
            .filter(|folder| folder.is_dir())
            .collect();
        let find = |name: &str| {
            let all = libraries.iter().map(|folder| folder.join(name));
            all.into_iter().find(|file| file.exists()).ok_or_else(|| {
                format!("{name} is not in {}: run tests/gpu-compile/drivers", release.display())
            })
        };
        let manifest = scratch.join(format!("{}.json", self.name.replace([' ', ','], "-")));
        let text = serde_json::json!({
            "file_format_version": "1.0.0",
            "ICD": { "library_path": find(self.driver)?, "api_version": "1.2.0" }
        });
        std::fs::write(&manifest, text.to_string()).map_err(|e| format!("{}: {e}", manifest.display()))?;
        let path = libraries.iter().map(|folder| folder.display().to_string()).collect::<Vec<_>>().join(":");
        let mut command = Command::new(find("ld-linux-x86-64.so.2")?);
        command.args(["--library-path", &path]);
        if !self.shim.is_empty() {
            command.arg("--preload").arg(find(self.shim)?);
        }
        command.arg(program);
        command
            .env("VK_DRIVER_FILES", &manifest)
            .env("VK_ICD_FILENAMES", &manifest)
            .env("NVK_I_WANT_A_BROKEN_VULKAN_DRIVER", "1")
            .env("MESA_SHADER_CACHE_DISABLE", "true")
            .env("VK_LAYER_PATH", release.join("usr/share/vulkan/explicit_layer.d"))
            .envs(self.environment.iter().copied());
        Ok(command)
    }
}
