//! Two devices, of which one is lost for good. (Both are the same software Vulkan: its manifest is there twice.)

use crate::common;
use crate::common::{layer, options, Bench};
use dpm_render::gpu::Gpu;
use std::path::PathBuf;
use vulkan_faults::Call;

/// Makes the loader see every software Vulkan twice; false where there is none.
fn twice() -> bool {
    let folders = ["/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d"];
    let mut manifests: Vec<PathBuf> = folders
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flat_map(|entries| entries.filter_map(Result::ok).map(|entry| entry.path()))
        .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("lvp")))
        .collect();
    let Some(first) = manifests.first().cloned() else { return false };
    let copy = std::env::temp_dir().join(format!("dpm-second-device-{}.json", std::process::id()));
    std::fs::copy(&first, &copy).expect("the temporary folder can be written");
    manifests.push(copy);
    let list = manifests.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(":");
    std::env::set_var("VK_DRIVER_FILES", &list);
    std::env::set_var("VK_ICD_FILENAMES", &list);
    // Mesa's layer sorts the list, and what is the same in all it looks at it may sort differently each time.
    std::env::set_var("NODEVICE_SELECT", "1");
    true
}

#[test]
fn where_the_device_does_not_come_back_another_one_goes_on_and_is_named() {
    if !twice() {
        return eprintln!("no software Vulkan in the usual places: nothing to be seen here");
    }
    let session = layer("");
    let devices = Gpu::list().unwrap();
    if devices.len() < 2 {
        return eprintln!("the loader shows a driver that is named twice only once: nothing to be seen here");
    }
    let mut bench = Bench::open();
    let wanted = bench.frame(0).unwrap();
    session.set("lost@frame=1; init-failed@device=1..,gpu=1");
    assert!(bench.frame(1).is_err_and(|e| e.is_loss()));
    let begin = std::time::Instant::now();
    let other = bench.gpu.reopen().unwrap_or_else(|e| panic!("{e}"));
    assert!(begin.elapsed() < std::time::Duration::from_secs(4) + common::SLACK, "{:?}", begin.elapsed());
    assert!(session.count(Call::Device) >= 2, "the same device was tried first");
    let mut next = Bench::on(other).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(next.frame(0).unwrap(), wanted);
    // And back: the second one is lost now, and the first one works again.
    session.set("lost@frame=1; init-failed@device=1..,gpu=2");
    assert!(next.frame(1).is_err_and(|e| e.is_loss()));
    let first = next.gpu.reopen().unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(Bench::on(first).unwrap().frame(0).unwrap(), wanted);
    // Without any the error names what was tried.
    session.set("init-failed@device=1..");
    let error = next.gpu.reopen().expect_err("none is left").to_string();
    assert!(error.matches(&options().device.unwrap_or(devices[0].name.clone())).count() >= 3, "{error}");
}
