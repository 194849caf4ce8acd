//! Parameters over HTTP: from a request to the frame that uses the change, and who may not change them.

use crate::common::{ask, RunWithPage, Viewer};

impl RunWithPage {
    fn change(&self, path: &str) -> (u16, String) {
        let answer = self.ask_signed("POST", path);
        (answer.status, answer.body)
    }

    /// The numbers of a parameter, and whether planning uses the newest version.
    fn value(&self, name: &str) -> (Vec<f64>, bool) {
        let told: serde_json::Value =
            serde_json::from_str(&self.ask("GET", "/api/parameters", &[]).body).unwrap();
        let all = told["all"].as_array().unwrap();
        let one = all.iter().find(|p| p["name"] == name).unwrap_or_else(|| panic!("no {name}: {told}"));
        let numbers = one["numbers"].as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).collect();
        (numbers, told["used"] == told["version"])
    }
}

#[test]
fn a_change_is_answered_when_a_frame_uses_it_and_is_taken_back() {
    let rig = RunWithPage::start("change");
    let (status, body) = rig.change("/api/parameters/set?name=exposure&value=1.5");
    assert!(status == 200 && body.contains("ok: exposure is 1.5, from frame "), "{body}");
    // The answer is the state: planning uses it already.
    assert_eq!(rig.value("exposure"), (vec![1.5], true));
    let (status, body) = rig.change("/api/parameters/set?name=body.bunny&value=1,0,0,0,0,0.5");
    assert!(status == 200 && body.contains("\"done\":true"), "{body}");
    assert_eq!(rig.value("body.bunny").0, [1.0, 0.0, 0.0, 0.0, 0.0, 0.5]);
    let used = || rig.monitor.live().snapshot().map_or(0, |s| s.frame.parameters);
    rig.wait("a frame that says so", || {
        rig.monitor.live().look();
        used() == 2
    });
    for _ in 0..2 {
        assert_eq!(rig.change("/api/parameters/undo").0, 200);
    }
    assert_eq!((rig.value("exposure"), rig.value("body.bunny").0), ((vec![1.0], true), vec![0.0; 6]));
    let (status, body) = rig.change("/api/parameters/undo");
    assert!(status == 400 && body.contains("nothing to take back"), "{body}");
    // This run has no rig file.
    rig.change("/api/parameters/set?name=exposure&value=2");
    let (status, body) = rig.change("/api/parameters/save");
    assert!(status == 400 && body.contains("no rig file"), "{body}");
    // BLACK holds whatever is changed.
    rig.order("black");
    assert_eq!(rig.change("/api/parameters/set?name=exposure&value=3").0, 200);
    assert_eq!(rig.monitor.projector().word(), "BLACK");
}

#[test]
fn the_room_has_every_body_and_the_projector_moves_in_it_by_hand() {
    let rig = RunWithPage::start("room");
    let answer = rig.ask("GET", "/api/room", &[]);
    assert_eq!(answer.status, 200, "{}", answer.body);
    let shapes: serde_json::Value = serde_json::from_str(&answer.body).unwrap();
    let mut viewer = Viewer::new(&rig);
    let numbers = |of: &serde_json::Value| -> Vec<f64> {
        of.as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).collect()
    };
    let before = viewer.next("room", |_| true);
    assert_eq!(before["bodies"].as_array().unwrap().len(), shapes["bodies"].as_array().unwrap().len());
    assert!(before["bodies"].as_array().unwrap().iter().all(|pose| numbers(pose).len() == 12));
    // Tracked bodies go where the tracker says.
    let bunny = shapes["bodies"].as_array().unwrap().iter().position(|b| b["tracked"] == "bunny").unwrap();
    viewer.next("room", |now| numbers(&now["bodies"][bunny])[9..] != numbers(&before["bodies"][bunny])[9..]);
    // Ten millimetres along the projector's own x.
    let from = numbers(&before["projector"]);
    assert_eq!(rig.change("/api/parameters/set?name=projector&value=10,0,0,0,0,0").0, 200);
    let moved = viewer.next("room", |now| numbers(&now["projector"]) != from);
    let to = numbers(&moved["projector"]);
    for k in 0..3 {
        assert!((to[9 + k] - from[9 + k] - 0.01 * from[k]).abs() < 2e-4, "{from:?} {to:?}");
    }
}

#[test]
fn nonsense_is_refused_and_changes_nothing() {
    let rig = RunWithPage::start("nonsense");
    for (path, status, word) in [
        ("/api/parameters/set?name=exposure&value=NaN", 400, "NaN is not allowed"),
        ("/api/parameters/set?name=exposure&value=1e99", 400, "must be 0.000001 to 1000000"),
        ("/api/parameters/set?name=exposure&value=", 400, "takes one number"),
        ("/api/parameters/set?name=brightness&value=1", 400, "there are: exposure"),
        ("/api/parameters/set?name=%ff&value=1", 400, "write ?name"),
        ("/api/parameters/set", 400, "write ?name"),
        ("/api/parameters/arm", 404, "set, undo and save"),
    ] {
        let (got, body) = rig.change(path);
        assert!(got == status && body.contains(word), "{path}: {got} {body}");
    }
    assert_eq!(rig.value("exposure"), (vec![1.0], true));
}

#[test]
fn nobody_changes_anything_without_the_token_under_another_name_or_from_another_site() {
    let rig = RunWithPage::start("stranger");
    let path = "/api/parameters/set?name=exposure&value=9";
    let host = rig.address.to_string();
    let [other, right] = ["/api/parameters/undo", path].map(|path| rig.signed("POST", path));
    let (host, right) = (("Host", host.as_str()), ("X-Dpm-Order", right.as_str()));
    for (headers, status) in [
        (vec![host], 401),
        (vec![host, ("X-Dpm-Order", other.as_str())], 403),
        (vec![("Host", "evil.example"), right], 421),
        (vec![host, right, ("Origin", "https://evil.example")], 403),
        (vec![host, right, ("Sec-Fetch-Site", "cross-site")], 403),
    ] {
        let answer = ask(rig.address, "POST", path, &headers);
        assert_eq!(answer.status, status, "{headers:?}: {}", answer.body);
    }
    // A link or a picture of another page is a GET.
    assert_eq!(rig.ask_signed("GET", path).status, 405);
    assert_eq!(rig.value("exposure"), (vec![1.0], true));
}
