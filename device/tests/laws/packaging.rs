//! The files in `packaging/` held to what the code opens and says.
#![cfg(all(feature = "usb", feature = "serial"))]

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::Command;

fn packaged(name: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../packaging").join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// One udev rule as key and value: `ATTR{idVendor}` to `1209`.
fn rules() -> Vec<BTreeMap<String, String>> {
    let text = packaged("60-dpm.rules");
    let lines = text.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#'));
    lines
        .map(|line| {
            line.split(',')
                .map(|part| {
                    let (key, value) = part.split_once('=').expect("an operator");
                    let value = value.trim_start_matches('=').trim().trim_matches('"');
                    (key.trim().trim_end_matches('+').to_owned(), value.to_owned())
                })
                .collect()
        })
        .collect()
}

/// The unit as section and key to its values.
fn unit() -> BTreeMap<(String, String), Vec<String>> {
    let mut section = String::new();
    let mut unit: BTreeMap<_, Vec<String>> = BTreeMap::new();
    for line in
        packaged("dpm.service").lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#'))
    {
        if let Some(name) = line.strip_prefix('[').and_then(|l| l.strip_suffix(']')) {
            name.clone_into(&mut section);
            continue;
        }
        let (key, value) = line.split_once('=').unwrap_or_else(|| panic!("neither section nor key: {line}"));
        unit.entry((section.clone(), key.to_owned())).or_default().push(value.to_owned());
    }
    unit
}

fn value(unit: &BTreeMap<(String, String), Vec<String>>, section: &str, key: &str) -> String {
    let values = unit.get(&(section.to_owned(), key.to_owned()));
    let values = values.unwrap_or_else(|| panic!("[{section}] {key} is missing"));
    assert_eq!(values.len(), 1, "[{section}] {key} stands once");
    values[0].clone()
}

/// Groups that the sysusers file creates where there are none, and those that `user` is a member of.
fn groups(user: &str) -> (BTreeSet<String>, BTreeSet<String>) {
    let (mut made, mut member) = (BTreeSet::new(), BTreeSet::new());
    for line in packaged("dpm-sysusers.conf").lines().filter(|l| !l.starts_with('#')) {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            [] => {}
            ["g", name, ..] => drop(made.insert(name.to_owned())),
            ["u", name, ..] => {
                // A user's own group comes with it.
                made.insert(name.to_owned());
                if name == user {
                    member.insert(name.to_owned());
                }
            }
            ["m", name, group] => {
                made.insert(group.to_owned());
                if name == user {
                    member.insert(group.to_owned());
                }
            }
            _ => panic!("not a line of sysusers.d: {line}"),
        }
    }
    (made, member)
}

/// Found in use, O7: the rule gave devices to the user at the seat only, and the service has no seat.
#[test]
fn the_rules_name_every_usb_device_that_is_opened_and_the_service_may_open_them() {
    use dpm_device::transport::usb as link;
    use dpm_dlpc900::usb as dlpc900;
    let opened: BTreeSet<(String, String)> =
        [(link::VENDOR_ID, link::PRODUCT_ID), (dlpc900::VENDOR, dlpc900::PRODUCT)]
            .map(|(vendor, product)| (format!("{vendor:04x}"), format!("{product:04x}")))
            .into();
    let rules = rules();
    let usb = rules.iter().filter(|r| r["SUBSYSTEM"] == "usb");
    let named: BTreeSet<_> =
        usb.map(|r| (r["ATTR{idVendor}"].clone(), r["ATTR{idProduct}"].clone())).collect();
    assert_eq!(named, opened);
    assert_eq!(rules.len(), opened.len() + 1, "and one for idle cores");
    let user = value(&unit(), "Service", "User");
    let (made, member) = groups(&user);
    for rule in rules {
        match rule["SUBSYSTEM"].as_str() {
            // Whoever sits at the machine gets projectors, and members of the group get idle cores that stay awake.
            "usb" => assert_eq!(rule["TAG"], "uaccess", "{rule:?}"),
            other => {
                let is = (other, rule["KERNEL"].as_str(), rule.get("TAG"));
                assert_eq!(is, ("misc", "cpu_dma_latency", None), "{rule:?}");
            }
        }
        let mode = u32::from_str_radix(&rule["MODE"], 8).expect("octal");
        assert_eq!((mode & 0o060, mode & 0o007), (0o060, 0), "the group and nobody else: {rule:?}");
        let group = &rule["GROUP"];
        assert!(made.contains(group), "no file of this project creates the group {group}");
        assert!(member.contains(group), "{user} is no member of {group}");
    }
    // The line that a refused user is told is one of these rules, as far as it goes.
    for told in [dlpc900::UDEV_RULE, link::UDEV_RULE] {
        let file = packaged("60-dpm.rules");
        let line = file.lines().find(|l| told.split(", ").all(|part| l.contains(part)));
        assert!(line.is_some(), "{told} is not in the rules");
    }
}

/// Found in use, O7: a unit that names a group that a distribution does not have (`plugdev` outside Debian) does not start, and one that
/// is restarted after a bad rig file goes on for ever.
#[test]
fn the_unit_starts_on_every_distribution_and_stops_trying() {
    let unit = unit();
    let user = value(&unit, "Service", "User");
    let (made, member) = groups(&user);
    assert!(made.contains(&value(&unit, "Service", "Group")));
    let named = unit.get(&("Service".into(), "SupplementaryGroups".into())).cloned().unwrap_or_default();
    for group in named.iter().flat_map(|g| g.split_whitespace()) {
        assert!(
            made.contains(group),
            "[Service] SupplementaryGroups={group} exists only where somebody made it"
        );
    }
    for group in ["video", "render", "dialout", "uucp"] {
        assert!(member.contains(group), "{group}");
    }
    assert_eq!(value(&unit, "Service", "Restart"), "on-failure");
    assert_eq!(value(&unit, "Service", "RestartPreventExitStatus"), "2 4");
    let limit: u32 = value(&unit, "Unit", "StartLimitBurst").parse().expect("a number");
    let seconds: u32 = value(&unit, "Unit", "StartLimitIntervalSec").parse().expect("seconds");
    let pause: u32 = value(&unit, "Service", "RestartSec").parse().expect("seconds");
    // Attempts a pause apart must reach the limit within its interval, or it limits nothing.
    assert!((2..=10).contains(&limit) && limit * (pause + 10) <= seconds, "{limit} in {seconds} s");
    assert_eq!(value(&unit, "Service", "StateDirectory"), "dpm");
    let runtime = value(&unit, "Service", "RuntimeDirectory");
    let environment = &unit[&("Service".to_owned(), "Environment".to_owned())];
    assert!(environment.contains(&format!("DPM_RUNTIME_DIR=/run/{runtime}")), "{environment:?}");
    // systemd divides a value that stands without quotes at its spaces.
    assert!(
        environment.iter().all(|v| !v.contains(' ') || v.starts_with('"') && v.ends_with('"')),
        "{environment:?}"
    );
    assert!(
        environment.contains(&"\"DPM_SET_SAFETY__START=by hand\"".to_owned()),
        "no light with nobody there"
    );
    for key in ["StateDirectoryMode", "RuntimeDirectoryMode"] {
        assert_eq!(value(&unit, "Service", key), "0700", "{key}: nobody else's");
    }
    // Longer than the 2 s within which the program is gone.
    let stop: f64 = value(&unit, "Service", "TimeoutStopSec").parse().expect("seconds");
    assert!(stop > 2.0);
    // The limits of a login and those of the service are the same.
    let limits = packaged("99-dpm-limits.conf");
    assert!(limits.contains(&format!("@dpm - rtprio {}", value(&unit, "Service", "LimitRTPRIO"))));
    assert!(
        limits.contains("@dpm - memlock unlimited") && value(&unit, "Service", "LimitMEMLOCK") == "infinity"
    );
}

/// Where there is a systemd, its own programs find nothing wrong.
#[test]
fn systemd_finds_nothing_wrong() {
    let folder = std::env::temp_dir().join(format!("dpm-packaging-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    // The program is not installed on the machine that tests it, and neither is its user.
    let text = packaged("dpm.service").replace("ExecStart=/usr/bin/dpm run", "ExecStart=/bin/true run");
    std::fs::write(folder.join("dpm.service"), text).expect("written");
    std::fs::write(folder.join("dpm.conf"), packaged("dpm-sysusers.conf")).expect("written");
    let run = |program: &str, words: &[&str]| {
        let output = Command::new(program).args(words).current_dir(&folder).output().ok()?;
        let told =
            String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout);
        Some((output.status.success(), told))
    };
    if let Some((_, told)) = run("systemd-analyze", &["verify", "--man=no", "dpm.service"]) {
        let ours: Vec<_> = told.lines().filter(|l| l.contains("dpm.service")).collect();
        assert!(ours.is_empty(), "{ours:#?}");
        assert!(!told.contains("Unknown"), "{told}");
    }
    let sysusers = folder.join("dpm.conf");
    if let Some((done, told)) = run("systemd-sysusers", &["--dry-run", sysusers.to_str().expect("text")]) {
        assert!(done || told.contains("unrecognized option"), "{told}");
        assert!(!told.contains("dpm.conf:"), "{told}");
    }
    std::fs::remove_dir_all(&folder).expect("removed");
}

/// What the unit, the scripts of the package and the page of the mock name is what the package holds.
#[test]
fn the_package_holds_what_its_parts_name() {
    let make = packaged("make");
    for placed in [
        "place packaging/dpm.service 644 usr/lib/systemd/system",
        "place packaging/dpm-sysusers.conf 644 usr/lib/sysusers.d dpm.conf",
        "place packaging/60-dpm.rules 644 usr/lib/udev/rules.d",
        "place packaging/99-dpm-limits.conf 644 etc/security/limits.d",
        "strip -o \"$tree/usr/bin/$program\"",
    ] {
        assert!(make.contains(placed), "{placed}");
    }
    assert!(packaged("debian/postinst").contains("systemd-sysusers dpm.conf"));
    let unit = unit();
    assert_eq!(value(&unit, "Unit", "Documentation"), "file:/usr/share/doc/dpm/README.Debian");
    assert!(make.contains("place packaging/debian/README.Debian 644 usr/share/doc/dpm\n"));
    // A purge takes the rig file that the unit runs, and the folder of its state.
    let rig = value(&unit, "Service", "ExecStart").split(' ').next_back().expect("a rig file").to_owned();
    let purge = packaged("debian/postrm");
    assert!(purge.contains(&format!("rm -f {rig} ")), "{rig}");
    assert!(purge.contains(&format!("/var/lib/{}", value(&unit, "Service", "StateDirectory"))));
    let devices =
        std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../hil-mock/src/serve")).expect("a folder");
    let page = packaged("hil-mock.1").replace('\\', "");
    for device in devices {
        let name =
            device.expect("an entry").file_name().to_string_lossy().trim_end_matches(".rs").replace('_', "-");
        // What several devices share.
        if !["mod", "bodies", "orders", "usb"].contains(&name.as_str()) {
            assert!(page.contains(&format!("fB{name}fR")), "hil-mock.1 does not name {name}");
        }
    }
}
