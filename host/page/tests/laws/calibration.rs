//! The guided page of a calibration over HTTP, with a run and without one.

use crate::common::{ask, NoSteps, RunWithPage};
use dpm_page::{Page, Settings};
use dpm_rig::config::{Overrides, Purpose, RigConfig};
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;

fn told(body: &str) -> Value {
    serde_json::from_str(body).unwrap_or_else(|e| panic!("{e}: {body}"))
}

#[test]
fn a_rig_that_runs_shows_its_steps_to_whoever_may_look() {
    let rig = RunWithPage::start("steps");
    let page = rig.ask("GET", "/calibration", &[]);
    assert!(page.status == 200 && page.head.contains("script-src 'nonce-"), "{}", page.head);
    // Both pages are whole, and every mark in them was replaced.
    for path in ["/", "/calibration"] {
        let body = rig.ask("GET", path, &[]).body;
        assert!(body.ends_with("</html>\n") && !body.contains("{{"), "{path}");
        assert!(body.contains("--ground: #") && body.contains("dpm-page"), "{path} lacks what both share");
    }
    let steps = told(&rig.ask("GET", "/api/calibration", &[]).body);
    assert!(steps["runs"] == true && steps["none"].as_str().unwrap().contains("mock"), "{steps}");
    assert_eq!(rig.ask("POST", "/api/calibration", &[]).status, 405);
    let host = ("Host", "evil.example");
    assert_eq!(ask(rig.address, "GET", "/api/calibration", &[host]).status, 421);
}

#[test]
fn a_rig_that_is_only_calibrated_has_steps_and_no_orders() {
    let text = "[projector]\nbackend = { kind = \"serial\", port = \"/dev/ttyACM1\" }\n[tracker]\nkind = \"natnet\"\n\
                [real_time]\npace = \"real\"\n[[scene.bodies]]\nname = \"hare\"\n";
    let purpose = Purpose { at_rest: true, calibrates: true, ..Purpose::default() };
    let config =
        RigConfig::parse_for("rig.toml", text, Path::new(""), &Overrides::default(), purpose).unwrap();
    let guide = Arc::new(NoSteps { rig: "/nowhere/rig.toml".into(), config });
    let address = "127.0.0.1:0".parse().unwrap();
    let settings = Settings { address, hosts: Vec::new(), token: None, guide };
    let page = Page::serve_calibration(settings).unwrap();
    let host = page.address().to_string();
    let get = |path: &str| ask(page.address(), "GET", path, &[("Host", host.as_str())]);
    let told = told(&get("/api/calibration").body);
    assert_eq!((told["runs"].as_bool(), told["next"].as_u64()), (Some(false), Some(0)));
    assert_eq!(told["ports"][0], "/dev/ttyACM9");
    let line = &told["steps"][3]["ways"][0]["line"];
    assert_eq!(line, "dpm calibrate body /nowhere/rig.toml --body hare");
    assert_eq!(get("/").body.len(), get("/calibration").body.len());
    for path in ["/api/state", "/metrics", "/api/events", "/api/parameters"] {
        assert_eq!(get(path).status, 404, "{path}");
    }
    let order = ask(page.address(), "POST", "/api/orders/arm", &[("Host", host.as_str())]);
    assert_eq!(order.status, 405);
}

#[test]
fn nobody_does_a_step_without_the_token_under_another_name_or_from_another_site() {
    let rig = RunWithPage::start("acts");
    let path = "/api/calibration/start?step=wand&way=0";
    let (host, right) = (rig.address.to_string(), rig.signed("POST", path));
    let (host, right) = (("Host", host.as_str()), ("X-Dpm-Order", right.as_str()));
    let wrong = ("X-Dpm-Order", "0");
    for (headers, status) in [
        (vec![host], 401),
        (vec![host, wrong], 403),
        (vec![("Host", "evil.example"), right], 421),
        (vec![host, right, ("Origin", "https://evil.example")], 403),
        (vec![host, right, ("Sec-Fetch-Site", "cross-site")], 403),
        // It is asked for, and what serves the page decides.
        (vec![host, right], 400),
        (vec![host, right], 403),
    ] {
        let answer = ask(rig.address, "POST", path, &headers);
        assert_eq!(answer.status, status, "{headers:?}: {}", answer.body);
    }
    assert_eq!(rig.ask_signed("GET", path).status, 405);
    let told = rig.ask_signed("POST", "/api/calibration/stop").body;
    assert!(told.contains("nobody does Stop here"), "{told}");
    assert_eq!(rig.ask_signed("POST", "/api/calibration/arm").status, 404);
    let told = rig.ask_signed("POST", &path.replace("way=0", "way=0&sensor=--set"));
    assert!(told.status == 400 && told.body.contains("path of a device file"), "{}", told.body);
}
