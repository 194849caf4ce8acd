use super::*;
use crate::config::{Overrides, RigConfig};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

fn place(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("dpm-standing-{}-{name}", std::process::id()));
    let _ = fs::remove_dir_all(&path);
    path
}

fn identity(backend: &str) -> Identity {
    let flags = vec![format!("projector.backend={backend}"), "real_time.pace=\"real\"".into()];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    Identity::of(&config.projector.backend)
}

fn opened(path: &std::path::Path, identity: &Identity) -> (OrderFile, Option<Stands>) {
    let (file, error, stands) = OrderFile::open(Some(path.into()), identity.clone());
    assert!(error.is_none(), "{error:?}");
    (file, stands)
}

/// Found in use, R4: SAFE did not outlive the program.
#[test]
fn r4_an_order_stands_until_it_is_forgotten() {
    let dir = place("stands");
    let usb = identity(r#"{ kind = "usb", serial_number = "A" }"#);
    assert_eq!(standing_in(&dir, &usb), None);
    let (file, stands) = opened(&dir, &usb);
    assert_eq!(stands, None);
    for (order, as_order) in
        [(Order::Safe, Order::Safe), (Order::Black, Order::Black), (Order::Freeze, Order::Black)]
    {
        let path = file.keep(order, By::Socket { uid: 0 }).unwrap();
        assert!(path.is_file());
        let (next, stands) = opened(&dir, &usb);
        let stands = stands.expect("it stands");
        assert_eq!(stands.order, as_order);
        assert!(stands.told.contains("ordered by user root over the control socket"), "{}", stands.told);
        next.forget().unwrap();
        assert_eq!(opened(&dir, &usb).1, None);
    }
    fs::remove_dir_all(dir).unwrap();
}

/// Found in use, R4: a file that cannot be understood counts as SAFE, whichever byte is wrong.
#[test]
fn r4_whatever_cannot_be_read_counts_as_safe() {
    let dir = place("damaged");
    let mock = identity(r#"{ kind = "mock" }"#);
    let (file, _) = opened(&dir, &mock);
    let path = file.keep(Order::Black, By::Key).unwrap();
    let whole = fs::read(&path).unwrap();
    let is_safe = |what: &str| {
        let stands = standing_in(&dir, &mock).unwrap_or_else(|| panic!("{what}: nothing stands"));
        assert_eq!(stands.order, Order::Safe, "{what}");
        assert!(stands.told.contains("counts as SAFE"), "{what}: {}", stands.told);
    };
    // Cut off anywhere, also in the blanks behind the text.
    for n in (0..whole.trim_ascii_end().len() + 2).chain([BYTES - 1]) {
        fs::write(&path, &whole[..n]).unwrap();
        is_safe(&format!("{n} bytes"));
    }
    let text = String::from_utf8(whole).unwrap();
    for (from, to) in
        [("\"version\":2", "\"version\":3"), ("black", "blacc"), ("black", "arm"), ("order", "odrer")]
    {
        assert!(text.contains(from));
        fs::write(&path, text.replace(from, to)).unwrap();
        is_safe(to);
    }
    fs::write(&path, vec![b' '; 5000]).unwrap();
    is_safe("too long");
    fs::write(&path, [0xff; 64]).unwrap();
    is_safe("no text");
    fs::remove_file(&path).unwrap();
    std::os::unix::fs::symlink("/dev/null", &path).unwrap();
    is_safe("a link");
    fs::remove_file(&path).unwrap();
    assert_eq!(standing_in(&dir, &mock), None);
    fs::set_permissions(&dir, fs::Permissions::from_mode(0o777)).unwrap();
    is_safe("a folder in which others can remove the file");
    let (unusable, error, _) = OrderFile::open(Some(dir.clone()), mock.clone());
    assert!(error.is_some() && unusable.keep(Order::Safe, By::Key).is_err());
    fs::remove_dir_all(&dir).unwrap();
    fs::write(&dir, b"a file").unwrap();
    is_safe("no folder");
    fs::remove_file(dir).unwrap();
}

#[test]
fn an_order_for_any_projector_of_a_kind_is_for_each_and_the_other_way_round() {
    let dir = place("kinds");
    let [a, b, any] = [", serial_number = \"A\"", ", serial_number = \"B\"", ""]
        .map(|more| identity(&format!("{{ kind = \"usb\"{more} }}")));
    let other = identity(r#"{ kind = "usb", product_id = 14 }"#);
    let stands = |i: &Identity| standing_in(&dir, i).is_some();
    opened(&dir, &a).0.keep(Order::Safe, By::Signal).unwrap();
    assert_eq!([&a, &b, &any, &other].map(stands), [true, false, true, false]);
    // Whoever arms any projector does not say that the light of A may return.
    opened(&dir, &any).0.forget().unwrap();
    assert_eq!([&a, &b, &any].map(stands), [true, false, false]);
    opened(&dir, &a).0.forget().unwrap();
    opened(&dir, &any).0.keep(Order::Safe, By::Projector).unwrap();
    assert_eq!([&a, &b, &any, &other].map(stands), [true, true, true, false]);
    opened(&dir, &b).0.forget().unwrap();
    assert_eq!([&a, &b, &any].map(stands), [true, false, true]);
    // Longer than a file name may be, and different only at the end.
    let [long, longer] =
        [400, 401].map(|n| identity(&format!("{{ kind = \"usb\", serial_number = {:?} }}", "x".repeat(n))));
    opened(&dir, &any).0.forget().unwrap();
    opened(&dir, &long).0.keep(Order::Safe, By::Key).unwrap();
    assert!(stands(&long) && !stands(&longer));
    // A place on the bus that does not last identifies nothing.
    let [one, two] = ["1:4", "1:5"].map(|place| {
        Identity::of(&super::identity_tests::backend(&format!("{{ kind = \"board\", device = {place:?} }}")))
    });
    assert_ne!(one.lock_name(), two.lock_name());
    opened(&dir, &one).0.keep(Order::Safe, By::Key).unwrap();
    assert!(stands(&two));
    fs::remove_dir_all(dir).unwrap();
}

#[test]
fn the_state_folder_is_the_first_that_is_named() {
    let choose = |set: &[(&str, &str)], is_root| {
        let set: Vec<(String, PathBuf)> =
            set.iter().map(|(n, v)| ((*n).to_owned(), PathBuf::from(v))).collect();
        choose(&|name| set.iter().find(|(n, _)| n == name).map(|(_, v)| v.clone()), is_root)
    };
    let all =
        [("DPM_STATE_DIR", "a"), ("STATE_DIRECTORY", "/b:/c"), ("XDG_STATE_HOME", "/d"), ("HOME", "/e")];
    assert_eq!(choose(&all, true), Some("a".into()));
    assert_eq!(choose(&all[1..], true), Some("/b".into()));
    assert_eq!(choose(&all[2..], true), Some("/var/lib/dpm".into()));
    assert_eq!(choose(&all[2..], false), Some("/d/dpm".into()));
    assert_eq!(choose(&all[3..], false), Some("/e/.local/state/dpm".into()));
    assert_eq!(choose(&[("HOME", "relative")], false), None);
}

#[test]
fn utc_knows_leap_years_and_ends_of_months() {
    for (seconds, wanted) in [
        (0, "1970-01-01T00:00:00Z"),
        (951_782_399, "2000-02-28T23:59:59Z"),
        (951_782_400, "2000-02-29T00:00:00Z"),
        (1_709_251_199, "2024-02-29T23:59:59Z"),
        (1_798_761_600, "2027-01-01T00:00:00Z"),
        (4_107_542_400, "2100-03-01T00:00:00Z"),
    ] {
        assert_eq!(utc(UNIX_EPOCH + Duration::from_secs(seconds)), wanted);
        assert_eq!(seconds_of_utc(wanted), Some(seconds));
    }
    // Every day of eight centuries there and back.
    for day in 0..292_194 {
        let seconds = 86_400 * day + 43_210;
        assert_eq!(seconds_of_utc(&utc(UNIX_EPOCH + Duration::from_secs(seconds))), Some(seconds));
    }
    for none in
        ["", "Z", "2024-02-29", "2024-13-01T00:00:00Z", "2024-01-01T24:00:00Z", "1969-12-31T23:59:59Z"]
    {
        assert_eq!(seconds_of_utc(none), None, "{none}");
    }
    assert_eq!(utc(UNIX_EPOCH - Duration::from_secs(1)), "1970-01-01T00:00:00Z");
}
