//! The handle by which tests give the layer to programs.

use std::path::Path;
use vulkan_faults::{FaultLayer, LAYER_NAME};

#[test]
fn a_program_gets_the_layer_beside_those_that_it_has() {
    let layer = FaultLayer::new("variables").unwrap();
    let variables = layer.variables("lost@frame=1");
    let value = |name: &str| variables.iter().find(|v| v.0 == name).map(|v| v.1.clone()).unwrap();
    let path = value("VK_LAYER_PATH");
    let folder = Path::new(path.split(':').next().unwrap());
    assert!(
        path.contains("/usr/share/vulkan/explicit_layer.d") || std::env::var_os("VK_LAYER_PATH").is_some()
    );
    assert!(value("VK_INSTANCE_LAYERS").contains(LAYER_NAME));
    assert_eq!(std::fs::read_to_string(value("DPM_VK_FAULTS_FILE")).unwrap(), "lost@frame=1");
    assert!(layer.set("nonsense").is_err());
    layer.set("late@frame=1,ms=2").unwrap();
    assert_eq!(std::fs::read_to_string(value("DPM_VK_FAULTS_FILE")).unwrap(), "late@frame=1,ms=2");
    let manifest = std::fs::read_to_string(folder.join("VkLayer_dpm_faults.json")).unwrap();
    let library = manifest.split('"').find(|part| part.ends_with(".so")).unwrap();
    assert!(Path::new(library).exists(), "{library}");
    assert!(layer.events().is_empty());
    let log = "12 lost frame 40\n13 noticed submit-after-loss 1\nhalf a li";
    std::fs::write(value("DPM_VK_FAULTS_LOG"), log).unwrap();
    let events = layer.events();
    assert_eq!(events.len(), 2);
    assert_eq!((events[0].at_ns, events[0].what.as_str(), events[0].number), (12, "lost", 40));
    assert_eq!(events[1].call, "submit-after-loss");
    drop(layer);
    assert!(!folder.exists());
}
