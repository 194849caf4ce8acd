//! The rig's events: state, figures, notes and pictures for those who look, and nothing for nobody.

use crate::common::{RunWithPage, Viewer};
use base64::prelude::{Engine, BASE64_STANDARD};

impl Viewer<'_> {
    /// The mean of the newest picture of the light, 0 to 255.
    fn brightness(&mut self, is: impl Fn(f64) -> bool) -> f64 {
        let mean = |pictures: &serde_json::Value| {
            let png = BASE64_STANDARD.decode(pictures["light"].as_str()?).unwrap();
            let picture = image::load_from_memory(&png).unwrap().to_luma8();
            assert!(picture.width() <= 320 && picture.height() <= 240);
            Some(picture.pixels().map(|p| f64::from(p.0[0])).sum::<f64>() / picture.pixels().len() as f64)
        };
        let found = self.next("pictures", |pictures| mean(pictures).is_some_and(&is));
        mean(&found).unwrap()
    }
}

#[test]
fn a_viewer_sees_the_light_go_and_come_back() {
    let rig = RunWithPage::start("light");
    assert!(!rig.monitor.live().is_looked_at(), "nobody looks");
    let mut viewer = Viewer::new(&rig);
    let bright = viewer.brightness(|mean| mean > 20.0);
    rig.order("black");
    let state = viewer.next("state", |now| now["light"]["word"] == "DARK BY ORDER");
    assert_eq!(state["light"]["state"], "dark_by_order");
    assert_eq!(
        (state["light"]["is_lit"].as_bool(), state["standing"].as_str()),
        (Some(false), Some("black"))
    );
    assert_eq!(viewer.brightness(|mean| mean < 1.0), 0.0);
    rig.order("arm");
    viewer.next("state", |now| now["light"]["word"] == "LIT" && now["light"]["is_lit"] == true);
    assert!(viewer.brightness(|mean| mean > 20.0) > bright * 0.5);
    viewer.next("pictures", |p| p["viewer"].is_string() && p["per_s"].as_f64().is_some_and(|n| n <= 10.0));
    let notes = rig.notes.clone();
    notes.add("a note <b>with signs</b>");
    viewer
        .next("notes", |all| all.as_array().unwrap().iter().any(|n| n["text"] == "a note <b>with signs</b>"));
    assert!(rig.monitor.live().is_looked_at());
    drop(viewer);
    rig.wait("an end of looking", || !rig.monitor.live().is_looked_at());
}

#[test]
fn figures_say_what_the_report_says() {
    let rig = RunWithPage::start("figures");
    let mut viewer = Viewer::new(&rig);
    let figures = viewer.next("figures", |f| f["report"]["frames_lit"].as_u64() > Some(3));
    let bounds = figures["setup"]["bounds_ms"].as_array().unwrap().len();
    let intervals = figures["intervals"].as_array().unwrap();
    assert!(intervals.iter().all(|i| i["up_to"].as_array().unwrap().len() == bounds));
    assert!(intervals.iter().any(|i| i["name"] == "motion_to_centre" && i["count"].as_u64() > Some(0)));
    let names: Vec<_> = figures["bodies"].as_array().unwrap().iter().map(|b| b["name"].clone()).collect();
    assert_eq!(names.len(), 2, "{names:?}");
    assert!(figures["bodies"].as_array().unwrap().iter().all(|b| b["dark"].is_null() && b["seen"] == true));
    assert!(
        figures["link"]["sessions"].as_u64() == Some(1) && figures["link"]["sent_mb"].as_f64() > Some(0.0)
    );
    assert!(figures["report"]["missed_by_cause"].as_object().unwrap().len() > 3);
    let later = viewer
        .next("figures", |f| f["report"]["frames_lit"].as_u64() > figures["report"]["frames_lit"].as_u64());
    assert_eq!(later["setup"], figures["setup"]);
}

#[test]
fn a_dark_body_says_why() {
    let flags = ["real_time.pace=\"real\"", "projector.frame_rate=\"100/1\"", "tracker.drop_out=1.0"];
    let rig = RunWithPage::with("dark", &flags);
    let mut viewer = Viewer::new(&rig);
    let figures = viewer.next("figures", |f| {
        f["bodies"].as_array().is_some_and(|all| !all.is_empty() && all.iter().all(|b| !b["dark"].is_null()))
    });
    assert_eq!(figures["bodies"][0]["dark"], "never_seen", "{figures}");
    assert!(figures["bodies"][0]["told"].as_str().unwrap().contains("never seen"));
}
