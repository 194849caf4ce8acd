//! What a projector on a serial port is, in a machine made of files: a device file holds its number and when it was made.

use super::room_tests::Disk;
use super::*;
use crate::config::{Overrides, RigConfig};
use crate::projectors::{self, DeviceName, ProjectorBackend, ProjectorKeys, ProjectorKind, SlotClock};
use dpm_common::keys::read::NotEmpty;
use dpm_common::section;
use port::{DeviceFile, System};
use std::fs;
use std::os::unix::fs::symlink;

/// A machine with nothing in it, and a state folder.
struct Machine {
    root: &'static str,
    disk: Disk,
}

fn node(file: &Path) -> Option<DeviceFile> {
    let text = fs::read_to_string(file).ok()?;
    let mut numbers = text.split_whitespace().map(|n| n.parse::<u32>().unwrap());
    let mut next = || numbers.next();
    Some(DeviceFile { number: [next()?, next()?], since: [next()?.into(), 0] })
}

section! {
    /// A board on a video cable whose name does not last, as a crate beside the rig adds it.
    pub struct BoardConfig {
        /// Its place on the bus.
        device: Option<String> = None, "", NotEmpty;
    }
}

impl ProjectorKeys for BoardConfig {
    fn device(&self) -> DeviceName {
        DeviceName { named: self.device.clone(), is_lasting: false, ..DeviceName::of("board") }
    }
}

static BOARD: ProjectorKind =
    ProjectorKind::of::<BoardConfig>("board", "board", "a board of a test.", "docs/PROJECTORS.md")
        .by_video(SlotClock::Firmware);

/// A projector of a rig file.
pub(super) fn backend(text: &str) -> ProjectorBackend {
    projectors::add(&BOARD);
    let overrides = Overrides {
        variables: vec![],
        flags: vec![
            format!("projector={{backend={text},width=1920,height=1080,frame_rate=60}}"),
            "real_time.pace=\"real\"".into(),
        ],
    };
    let rig = RigConfig::parse("rig.toml", "", Path::new(""), &overrides);
    rig.unwrap_or_else(|e| panic!("{e}")).projector.backend
}

impl Machine {
    fn new(name: &str) -> Self {
        let root = std::env::temp_dir().join(format!("dpm-machine-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&root);
        for folder in ["dev/pts", "dev/serial/by-id", "sys/dev/char"] {
            fs::create_dir_all(root.join(folder)).unwrap();
        }
        let root = Box::leak(root.to_str().unwrap().to_owned().into_boxed_str());
        Self { root, disk: Disk::default() }
    }

    fn at(&self, path: &str) -> PathBuf {
        Path::new(self.root).join(path)
    }

    /// A device file that was made at an instant, where sysfs has `folder` for it.
    fn made(&self, file: &str, number: [u32; 2], since: u32, folder: Option<&str>) {
        let [major, minor] = number;
        fs::write(self.at(&format!("dev/{file}")), format!("{major} {minor} {since}")).unwrap();
        let link = self.at(&format!("sys/dev/char/{major}:{minor}"));
        let _ = fs::remove_file(&link);
        if let Some(folder) = folder {
            fs::create_dir_all(self.at(folder)).unwrap();
            symlink(self.at(folder), link).unwrap();
        }
    }

    /// An adapter in a socket, as `/dev/ttyUSBn`.
    fn plugged(&self, n: u32, since: u32, socket: &str, serial: Option<&str>) {
        let device = format!("sys/devices/pci0000:00/0000:00:14.0/usb1/{socket}");
        let folder = format!("{device}/{socket}:1.0/ttyUSB{n}/tty/ttyUSB{n}");
        self.made(&format!("ttyUSB{n}"), [188, n], since, Some(&folder));
        for (name, text) in [("idVendor", Some("0403")), ("idProduct", Some("6001")), ("serial", serial)] {
            let file = self.at(&format!("{device}/{name}"));
            let _ = fs::remove_file(&file);
            text.into_iter().for_each(|text| fs::write(&file, format!("{text}\n")).unwrap());
        }
    }

    fn unplugged(&self, n: u32) {
        fs::remove_file(self.at(&format!("dev/ttyUSB{n}"))).unwrap();
        fs::remove_file(self.at(&format!("sys/dev/char/188:{n}"))).unwrap();
    }

    fn link(&self, file: &str, to: &str) {
        symlink(to, self.at(&format!("dev/{file}"))).unwrap();
    }

    /// The projector at a path, as a program that starts now sees it.
    fn projector(&self, path: &str) -> Identity {
        let port = backend(&format!("{{ kind = \"serial\", port = \"/dev/{path}\" }}"));
        Identity::on(self.system(), &port)
    }

    fn system(&self) -> System {
        System { root: self.root, node }
    }

    fn safe_at(&self, path: &str) {
        self.file(path).keep(Order::Safe, By::Key).unwrap();
    }

    fn file(&self, path: &str) -> OrderFile {
        let (file, error) = OrderFile::in_folder(Box::new(self.disk.clone()), self.projector(path));
        assert!(error.is_none(), "{error:?}");
        file
    }

    fn holds(&self, path: &str) -> bool {
        standing_in_folder(&self.disk, &self.projector(path)).is_some()
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(self.root);
    }
}

/// Found in use, R1 and R6: SAFE by a link of the port, and a run by the port itself was lit; two programs by two names
/// of one port both came as far as the port.
#[test]
fn every_name_of_a_port_is_one_projector() {
    let machine = Machine::new("names");
    machine.plugged(0, 5, "1-2", Some("AB12"));
    machine.made("pts/5", [136, 5], 1, None);
    machine.link("projector", "pts/5");
    machine.link("serial/by-id/usb-FTDI_AB12-if00", "../../ttyUSB0");
    for (link, path) in [("projector", "pts/5"), ("serial/by-id/usb-FTDI_AB12-if00", "ttyUSB0")] {
        let [one, other] = [link, path].map(|path| machine.projector(path));
        assert_eq!(
            (one.order_name(None), one.lock_name()),
            (other.order_name(None), other.lock_name()),
            "{path}"
        );
        assert!(one.is_one_device());
        machine.safe_at(link);
        assert!(machine.holds(path), "SAFE by {link} does not hold {path}");
        machine.file(path).forget().unwrap();
        assert!(!machine.holds(link), "ARM by {path} does not lift SAFE by {link}");
    }
    assert_ne!(machine.projector("pts/5").lock_name(), machine.projector("ttyUSB0").lock_name());
}

#[test]
fn an_adapter_is_known_by_its_serial_number_whatever_the_kernel_calls_it() {
    let machine = Machine::new("numbers");
    machine.plugged(0, 5, "1-2", Some("AB12"));
    machine.safe_at("ttyUSB0");
    machine.unplugged(0);
    machine.plugged(1, 9, "1-3", Some("AB12"));
    assert!(machine.holds("ttyUSB1"), "it came back under another number, in another socket");
    // Another adapter has got the name.
    let of_run = machine.projector("ttyUSB1");
    machine.plugged(0, 10, "1-2", Some("CD34"));
    assert!(
        of_run.is_certainly_not(&machine.projector("ttyUSB0")),
        "a run does not go on with another adapter"
    );
    assert!(!of_run.is_certainly_not(&of_run) && !of_run.is_certainly_not(&machine.projector("ttyUSB7")));
    assert!(!machine.holds("ttyUSB0"), "a different serial number is proof");
    assert_ne!(machine.projector("ttyUSB0").lock_name(), machine.projector("ttyUSB1").lock_name());
    machine.file("ttyUSB0").forget().unwrap();
    assert!(machine.holds("ttyUSB1"), "whoever arms another projector lifts nothing");
}

#[test]
fn without_serial_numbers_only_a_port_that_is_still_there_is_another_one() {
    let machine = Machine::new("doubt");
    machine.plugged(0, 5, "1-2", None);
    machine.plugged(1, 6, "1-3", None);
    machine.safe_at("ttyUSB0");
    assert!(machine.holds("ttyUSB0") && !machine.holds("ttyUSB1"));
    assert!(machine.holds("ttyUSB7"), "a port that does not exist proves nothing");
    // The adapter may have come back in the socket of the other one.
    machine.unplugged(0);
    assert!(machine.holds("ttyUSB1"));
    // Another boot: the kernel has made both files anew, and may have numbered them the other way round.
    machine.plugged(0, 50, "1-3", None);
    machine.plugged(1, 50, "1-2", None);
    assert!(machine.holds("ttyUSB0") && machine.holds("ttyUSB1"));
}

#[test]
fn a_pseudo_terminal_is_another_one_while_that_of_the_order_lives() {
    let machine = Machine::new("pts");
    machine.made("pts/5", [136, 5], 1, None);
    machine.made("pts/7", [136, 7], 2, None);
    machine.safe_at("pts/5");
    assert!(machine.holds("pts/5") && !machine.holds("pts/7"));
    // The program behind it has ended, and a shell has got its number.
    machine.made("pts/5", [136, 5], 3, None);
    assert!(machine.holds("pts/7"));
}

#[test]
fn ports_of_the_board_and_ports_of_one_adapter_stay_apart() {
    let machine = Machine::new("board");
    let boot = |since| {
        machine.made("ttyS0", [4, 64], since, Some("sys/devices/pnp0/00:00/tty/ttyS0"));
        machine.made("ttyS1", [4, 65], since, Some("sys/devices/pnp0/00:01/tty/ttyS1"));
    };
    boot(1);
    machine.safe_at("ttyS0");
    boot(2);
    assert!(machine.holds("ttyS0") && !machine.holds("ttyS1"));
    machine.plugged(0, 5, "1-2", Some("AB12"));
    let second = "sys/devices/pci0000:00/0000:00:14.0/usb1/1-2/1-2:1.1/ttyUSB1/tty/ttyUSB1";
    machine.made("ttyUSB1", [188, 1], 5, Some(second));
    machine.file("ttyUSB0").forget().unwrap();
    machine.safe_at("ttyUSB0");
    assert!(machine.holds("ttyUSB0") && !machine.holds("ttyUSB1"));
    assert_ne!(machine.projector("ttyUSB0").lock_name(), machine.projector("ttyUSB1").lock_name());
}

#[test]
fn who_arms_in_doubt_lifts_the_order_for_that_projector_alone() {
    let machine = Machine::new("lifted");
    machine.plugged(0, 5, "1-2", None);
    machine.safe_at("ttyUSB0");
    machine.unplugged(0);
    machine.plugged(1, 9, "1-3", None);
    let told = standing_in_folder(&machine.disk, &machine.projector("ttyUSB1")).unwrap().told;
    assert!(told.contains("for projector on /dev/ttyUSB0, which may be this one"), "{told}");
    machine.file("ttyUSB1").forget().unwrap();
    assert!(!machine.holds("ttyUSB1"));
    machine.plugged(0, 11, "1-2", None);
    assert!(machine.holds("ttyUSB0"), "nobody has armed the projector of the order");
    // Re-plugged, it may be another device again.
    machine.plugged(1, 12, "1-3", None);
    machine.unplugged(0);
    assert!(machine.holds("ttyUSB1"));
    for n in 0..20 {
        machine.plugged(1, 20 + n, "1-3", None);
        machine.file("ttyUSB1").forget().unwrap();
        assert!(!machine.holds("ttyUSB1"), "the list of a file is bounded, and its newest entry counts");
    }
}

/// The files of the version before, with their names.
#[test]
fn an_order_of_version_1_holds_every_port_and_goes_when_its_own_is_armed() {
    let old = br#"{"version":1,"order":"safe","at":"2026-03-01T12:00:00Z","by":"a key","process":7,"projector":"projector on /dev/ttyUSB0"}"#;
    let machine = Machine::new("old");
    machine.plugged(0, 5, "1-2", Some("AB12"));
    machine.plugged(1, 5, "1-3", Some("CD34"));
    machine.disk.replace("projector-on--dev-ttyUSB0.order", old).unwrap();
    assert!(machine.holds("ttyUSB0") && machine.holds("ttyUSB1"));
    machine.file("ttyUSB1").forget().unwrap();
    assert!(machine.holds("ttyUSB0") && !machine.holds("ttyUSB1"));
    machine.disk.replace("projector-on--dev-ttyUSB0.order", old).unwrap();
    machine.file("ttyUSB0").forget().unwrap();
    assert!(!machine.holds("ttyUSB0") && !machine.holds("ttyUSB1"));
    // A damaged one does not say for which it was.
    machine.disk.replace("projector-on--dev-ttyUSB0.order", &old[..40]).unwrap();
    machine.file("ttyUSB1").forget().unwrap();
    assert!(machine.holds("ttyUSB0") && !machine.holds("ttyUSB1"));
}

#[test]
fn an_order_for_one_display_holds_all_and_windows_and_video_boards_too() {
    let machine = Machine::new("displays");
    let [hdmi, dp, window, board] = [
        "{ kind = \"display\", connector = \"HDMI-A-1\" }",
        "{ kind = \"display\", connector = \"DP-1\" }",
        "{ kind = \"window\" }",
        "{ kind = \"board\" }",
    ]
    .map(|text| Identity::on(machine.system(), &backend(text)));
    let disk = Disk::default();
    let of = |identity: &Identity| OrderFile::in_folder(Box::new(disk.clone()), identity.clone()).0;
    let all = [&hdmi, &dp, &window, &board];
    for order_of in all {
        of(order_of).keep(Order::Black, By::Key).unwrap();
        for other in all {
            assert!(standing_in_folder(&disk, other).is_some(), "{order_of} does not hold {other}");
        }
        of(order_of).forget().unwrap();
    }
    of(&hdmi).keep(Order::Black, By::Key).unwrap();
    of(&window).forget().unwrap();
    let held = all.map(|identity| standing_in_folder(&disk, identity).is_some());
    assert_eq!(held, [true, true, false, true]);
}

/// Two displays that tell their serial numbers are two, whatever the connector; one that tells none may be either.
#[test]
fn a_display_is_known_by_its_edid_at_any_connector() {
    let machine = Machine::new("edid");
    let plug = |connector: &str, edid: &[u8]| {
        let folder = machine.at("sys/class/drm").join(format!("card0-{connector}"));
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("edid"), edid).unwrap();
    };
    let display = |connector: &str| {
        let at = backend(&format!("{{ kind = \"display\", connector = {connector:?} }}"));
        Identity::on(machine.system(), &at)
    };
    let any = || Identity::on(machine.system(), &backend("{ kind = \"display\" }"));
    let holds = |identity: &Identity| standing_in_folder(&machine.disk, identity).is_some();
    let file = |identity: Identity| OrderFile::in_folder(Box::new(machine.disk.clone()), identity).0;
    let (a, b) = (edid::tests::edid(7, None), edid::tests::edid(8, None));
    plug("HDMI-A-1", &a);
    plug("DP-1", &[]);
    file(display("HDMI-A-1")).keep(Order::Safe, By::Key).unwrap();
    assert!(holds(&display("HDMI-A-1")) && holds(&any()));
    // It moves to the other connector, and another one takes its place.
    plug("HDMI-A-1", &b);
    plug("DP-1", &a);
    assert!(!holds(&display("HDMI-A-1")) && holds(&display("DP-1")));
    // Nothing says which one a rig file means that names none; and one without a number may be the one.
    assert!(holds(&any()));
    plug("HDMI-A-1", &edid::tests::edid(0, None));
    assert!(holds(&display("HDMI-A-1")));
    file(display("DP-1")).forget().unwrap();
    assert!(!holds(&display("DP-1")) && !holds(&display("HDMI-A-1")));
}

/// A projector that has told its serial number takes its order along to any port, and leaves none to another one.
#[test]
fn an_order_goes_with_the_serial_number_of_the_projector() {
    let machine = Machine::new("hello");
    machine.plugged(0, 10, "1-1", Some("A"));
    machine.plugged(1, 11, "1-2", Some("B"));
    let (one, other) = (0x1234_5678_9abc_def0_u64, 0xfeed_u64);
    let first = machine.file("ttyUSB0");
    first.hear(Some(one));
    first.keep(Order::Safe, By::Key).unwrap();
    // At another port nothing says so before it is asked; then it does.
    let second = machine.file("ttyUSB1");
    assert!(!machine.holds("ttyUSB1"));
    assert_eq!(second.by_serial_number(), [(one, Order::Safe)]);
    let stands = |serial| of_device(Some(&machine.disk), None, serial).map(|stands| stands.order);
    assert_eq!([one, other, 0, 1].map(stands), [Some(Order::Safe), None, None, None]);
    // Another projector at the first port: who arms it lifts the order for this port, and not for the projector.
    first.hear(Some(other));
    first.forget().unwrap();
    assert!(!machine.holds("ttyUSB0"));
    assert_eq!(second.by_serial_number(), [(one, Order::Safe)]);
    // Who arms the projector itself lifts it, wherever it is.
    second.hear(Some(one));
    second.forget().unwrap();
    assert!(second.by_serial_number().is_empty() && !machine.holds("ttyUSB0"));
    assert_eq!(stands(one), None);
}

/// Found in use again: the order for a projector was lost when another one was made dark at the same port.
#[test]
fn orders_for_two_projectors_at_one_port_stand_side_by_side() {
    let machine = Machine::new("two");
    machine.plugged(0, 10, "1-1", Some("A"));
    let (one, other) = (0x51, 0x52);
    let start = |device| {
        let file = machine.file("ttyUSB0");
        let is_held = machine.holds("ttyUSB0");
        let held = file.by_serial_number().into_iter().any(|(of, _)| Some(of) == device);
        file.hear(device);
        (file, is_held || held)
    };
    let (file, _) = start(Some(one));
    file.keep(Order::Safe, By::Socket { uid: 0 }).unwrap();
    // The other one: a person arms it, and makes it dark later.
    let (file, is_dark) = start(Some(other));
    assert!(is_dark, "before HELLO nothing says that it is another one");
    file.forget().unwrap();
    assert!(!start(Some(other)).1);
    file.keep(Order::Black, By::Key).unwrap();
    file.keep(Order::Black, By::Key).unwrap();
    file.forget().unwrap();
    file.keep(Order::Black, By::Key).unwrap();
    // The first one is back, and is given its order again, which says who gave it first.
    let (file, is_dark) = start(Some(one));
    assert!(is_dark && file.by_serial_number().contains(&(one, Order::Safe)));
    file.keep(Order::Safe, By::SerialNumber).unwrap();
    let told = standing_in_folder(&machine.disk, &machine.projector("ttyUSB0")).unwrap();
    assert!(told.order == Order::Safe && told.told.contains("user root over the control socket"), "{told:?}");
    // ARM before HELLO lifts them for the port alone.
    start(None).0.forget().unwrap();
    assert!(!machine.holds("ttyUSB0") && start(Some(one)).1 && start(Some(other)).1);
    // Each is lifted by its own ARM.
    file.forget().unwrap();
    assert!(!start(Some(one)).1 && start(Some(other)).1);
    start(Some(other)).0.forget().unwrap();
    assert!(!start(Some(one)).1 && !start(Some(other)).1 && !machine.holds("ttyUSB0"));
}

/// Orders of one user hold the projector for every other user, and root too; each lifts them for themselves.
#[test]
fn an_order_of_one_user_holds_for_all_users() {
    let machine = Machine::new("users");
    machine.plugged(0, 10, "1-1", Some("A"));
    machine.plugged(1, 11, "1-2", Some("B"));
    let shared = machine.at("shared");
    fs::create_dir(&shared).unwrap();
    let me = dpm_common::unix::user();
    assert!(Others::in_folder(&shared, me).is_none(), "a folder in which anybody may touch anything");
    fs::set_permissions(&shared, std::os::unix::fs::PermissionsExt::from_mode(0o1777)).unwrap();
    let Some(theirs) = Others::in_folder(&shared, me) else {
        assert_ne!(me, 0, "the folder must be root's");
        return;
    };
    // Two users with a state folder each; the files of both belong to the one who runs this.
    let seen = |path: &str, folder: &Path| {
        let others = Others::in_folder(&shared, me + 1);
        OrderFile::open_beside(Some(folder.into()), others, machine.projector(path))
    };
    let [own, other] = ["own", "other"].map(|name| machine.at(name));
    let (file, error, _) =
        OrderFile::open_beside(Some(own.clone()), Some(theirs), machine.projector("ttyUSB0"));
    assert!(error.is_none(), "{error:?}");
    file.hear(Some(7));
    file.keep(Order::Safe, By::Key).unwrap();
    let (second, _, stands) = seen("ttyUSB0", &other);
    let stands = stands.expect("it holds for the other user");
    assert!(stands.order == Order::Safe && stands.told.contains("ordered by a key"), "{stands:?}");
    assert!(seen("ttyUSB1", &other).2.is_none(), "it is for another adapter");
    assert_eq!(seen("ttyUSB1", &other).0.by_serial_number(), [(7, Order::Safe)]);
    // What is damaged, or of another's name, holds nothing.
    fs::write(shared.join(format!("dpm-order-{me}-projector-on-x.order")), "{").unwrap();
    fs::copy(
        shared.join(format!("dpm-order-{me}-{}", machine.projector("ttyUSB0").order_name(Some(7)))),
        shared.join(format!("dpm-order-{}-projector-on-x.order", me + 9)),
    )
    .unwrap();
    second.hear(Some(7));
    second.forget().unwrap();
    assert!(seen("ttyUSB0", &other).2.is_none() && seen("ttyUSB1", &other).0.by_serial_number().is_empty());
    assert!(standing_in(&own, &machine.projector("ttyUSB0")).is_some(), "for its own user it stands");
    // Given anew, it holds again; lifted by its own user, it holds for nobody.
    file.keep(Order::Black, By::Key).unwrap();
    assert!(seen("ttyUSB0", &other).2.is_some());
    file.forget().unwrap();
    assert!(seen("ttyUSB0", &other).2.is_none());
}
