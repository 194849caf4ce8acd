//! What a card offers and a rig file wants, into what is set, or into a refusal that names what to write.

use crate::common;
use crate::common::{settings, with, SMALL};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::FrameRate;
use dpm_display::encoding::Encoding;
use dpm_display::fake::display;
use dpm_display::kms::{Connector, Domain, PropertyOwner};
use dpm_display::mode::{ModeWish, Timing};
use dpm_display::set_up::{plan, DisplaySettings};

fn offered() -> Vec<Connector> {
    display(&[SMALL]).connectors
}

fn refused(connectors: &[Connector], change: impl FnOnce(&mut DisplaySettings)) -> String {
    let mut settings = settings(Encoding::Planes24);
    change(&mut settings);
    plan(connectors, &settings).expect_err("refused").0
}

#[test]
fn everything_that_keeps_bits_exact_is_set() {
    let plan = plan(&offered(), &settings(Encoding::Planes24)).unwrap();
    let set = |owner, name: &str| {
        plan.setup
            .properties
            .iter()
            .find(|(o, n, _)| (*o, n.as_str()) == (owner, name))
            .map(|(.., value)| *value)
    };
    assert_eq!(set(PropertyOwner::Connector, "max bpc"), Some(8));
    assert_eq!(set(PropertyOwner::Connector, "Broadcast RGB"), Some(1), "Full");
    assert_eq!(set(PropertyOwner::Connector, "dithering mode"), Some(1), "off");
    assert_eq!(set(PropertyOwner::Crtc, "GAMMA_LUT"), Some(0));
    assert_eq!(set(PropertyOwner::Crtc, "VRR_ENABLED"), Some(0));
    assert_eq!(set(PropertyOwner::Crtc, "CTM"), None, "the driver has none");
    assert!(plan.warnings.is_empty(), "{:?}", plan.warnings);
    // 3 ms, and half of the blank of 6 ms.
    assert_eq!(plan.panel.lead_ns, 6_000_000);
}

#[test]
fn a_property_that_a_cable_needs_is_refused_for_bits_and_named_for_colours() {
    for gone in ["max bpc", "Broadcast RGB"] {
        let mut connectors = offered();
        connectors[0].properties.retain(|p| p.name != gone);
        let told = refused(&connectors, |_| {});
        assert!(told.contains(gone) && told.contains("projector.backend.without"), "{told}");
        let waived = DisplaySettings { without: vec![gone.into()], ..settings(Encoding::Planes24) };
        assert!(plan(&connectors, &waived).unwrap().warnings[0].contains(gone));
        let colours = plan(&connectors, &settings(Encoding::Rgb8)).unwrap();
        assert!(colours.warnings[0].contains(gone), "{:?}", colours.warnings);
        // The kernel's virtual display has no cable.
        connectors[0].is_virtual = true;
        assert!(plan(&connectors, &settings(Encoding::Planes24)).unwrap().warnings.is_empty());
    }
    // One that is there and cannot have the value is as bad.
    let mut connectors = offered();
    connectors[0].properties[0].domain = Domain::Range(10, 16);
    assert!(refused(&connectors, |_| {}).contains("max bpc"));
    let mut connectors = offered();
    connectors[0].properties[2].is_mutable = false;
    assert!(refused(&connectors, |_| {}).contains("dithering mode"));
}

#[test]
fn every_refusal_says_what_to_write() {
    let all = offered();
    let told = refused(&all, |s| s.rate = FrameRate::new(947, 1).unwrap());
    assert!(
        told.contains("projector.frame_rate = \"947\"") && told.contains("write frame_rate = \"60\""),
        "{told}"
    );
    let told = refused(&all, |s| s.raster = Raster::new(1024, 768).unwrap());
    assert!(told.contains("projector.width = 1024") && told.contains("70 x 16"), "{told}");
    let told = refused(&all, |s| s.connector = Some("DP-7".into()));
    assert!(told.contains("\"DP-7\"") && told.contains("HDMI-A-1, DP-1"), "{told}");
    let told = refused(&all, |s| s.connector = Some("DP-1".into()));
    assert!(told.contains("no display answers there") && told.contains("HDMI-A-1"), "{told}");
    let told = refused(&all, |s| s.mode = "1920x1080@60".parse().unwrap());
    assert!(told.contains("projector.backend.mode") && told.contains("70x16@60.000"), "{told}");
    let told = refused(&all, |s| s.commit_ns = 14_000_000);
    assert!(told.contains("commit_us = 14000") && told.contains("write 11999 at most"), "{told}");
    let told = refused(&all, |s| s.schedule = PlaneSchedule::mono8());
    assert!(told.contains("projector.planes = 8") && told.contains("24"), "{told}");
    let mut two = all.clone();
    two[1].is_connected = true;
    assert!(refused(&two, |s| s.connector = None).contains("HDMI-A-1, DP-1"));
    assert!(refused(&all[1..], |s| s.connector = None).contains("switched on"));
    assert!(plan(&all, &DisplaySettings { connector: None, ..settings(Encoding::Rgb8) }).is_ok());
}

/// A timing of one's own is taken whatever the display offers, and its rate is exact.
#[test]
fn a_timing_that_is_written_is_taken() {
    let cvt = "138.51 1920 1968 2000 2080 1080 1083 1088 1111 +hsync -vsync";
    let told = refused(&offered(), |s| {
        s.mode = cvt.parse().unwrap();
        s.raster = Raster::new(1920, 1080).unwrap();
    });
    let exact = told.rsplit("frame_rate = ").next().unwrap().trim_matches('"').to_owned();
    let (num, den) = exact.split_once('/').unwrap();
    let rate = FrameRate::new(num.parse().unwrap(), den.parse().unwrap()).unwrap();
    assert!((rate.hz() - 138_510_000.0 / (2080.0 * 1111.0)).abs() < 1e-9);
    let mut taken = settings(Encoding::Planes24);
    (taken.mode, taken.raster, taken.rate) = (cvt.parse().unwrap(), Raster::new(1920, 1080).unwrap(), rate);
    let ModeWish::Exactly(timing) = taken.mode else { panic!("a timing") };
    assert_eq!(plan(&offered(), &taken).unwrap().setup.timing, Timing { ..timing });
    let state = common::shared();
    with(&state, |s| assert!(!s.is_black));
}
