//! A display as the medium of a link: the thread of its panel, the in-process cable to it, and what happens when the display
//! is unplugged and comes back.

use std::ffi::OsString;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::mpsc::{channel, Receiver, TryRecvError};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dpm_common::guardian::Guardian;
use dpm_common::realtime::{enter_frame_path, os::set_timer_slack_ns, ThreadRights};
use dpm_device::link::{packet_bytes, COMMIT_BYTES};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::inproc::{threaded, DeviceEnd, HostEnd};
use dpm_device::transport::{Lane, SendError, Transport, TransportError};
use dpm_handoff::wake::WaitPolicy;

use crate::kms::Kms;
use crate::lease::{self, Access};
use crate::panel::{DisplayCounts, DisplayPanel, PanelSettings};
use crate::scan_out::{DisplayError, ScanOut};
use crate::set_up::{plan, DisplaySettings};

/// Buffers of the cable: one is being filled, one is being read, one is spare.
const CABLE_BUFFERS: usize = 3;
/// Longest sleep of the panel's thread, nanoseconds.
const REST_NS: i64 = 100_000_000;
/// How long the panel's thread may need to end. Afterwards it is left behind; the process's end ends it.
const END_WITHIN: Duration = Duration::from_millis(500);

/// What shows pictures and shows black now, and what a panel must know of it.
pub struct PanelOutput {
    /// What shows pictures.
    pub out: Box<dyn ScanOut>,
    /// What the panel has to know.
    pub panel: PanelSettings,
    /// Its name in messages.
    pub name: String,
    /// What the operator should know.
    pub warnings: Vec<String>,
}

/// Opens a display, sets it up, and shows black. It may take seconds.
pub type Opener = Arc<dyn Fn() -> Result<PanelOutput, TransportError> + Send + Sync>;

/// The opener of a display on a graphics card that `card` opens, set up as `settings` say.
pub fn on_card(
    card: impl Fn() -> Result<Box<dyn Kms>, DisplayError> + Send + Sync + 'static,
    settings: DisplaySettings,
) -> Opener {
    Arc::new(move || {
        let device = || device_of(&settings);
        let failed = |e: DisplayError| e.of(device());
        let mut kms = card().map_err(failed)?;
        let connectors = kms.connectors().map_err(failed)?;
        let refused = |why: String| TransportError::Unsuitable { device: device(), why };
        let plan = plan(&connectors, &settings).map_err(|e| refused(e.0))?;
        kms.start(&plan.setup).map_err(failed)?;
        let lent = kms.lender().map(|lender| format!(", lent by {lender}")).unwrap_or_default();
        let name = format!("display {} ({}){lent}", plan.setup.connector, plan.setup.timing);
        Ok(PanelOutput { out: kms, panel: plan.panel, name, warnings: plan.warnings })
    })
}

/// The display of `settings` in messages.
fn device_of(settings: &DisplaySettings) -> String {
    match &settings.connector {
        Some(connector) => format!("display {connector}"),
        None => "display".into(),
    }
}

/// Looks whether the display of `settings` is there and has its mode. No display is taken.
///
/// # Errors
/// What [`on_card`] would find with the card of [`lease::opener`], as far as it can be seen without taking the display.
pub fn look(card: Option<&Path>, access: Access, settings: &DisplaySettings) -> Result<(), TransportError> {
    let connectors = lease::look(card, settings.connector.as_deref(), access);
    let Some(connectors) = connectors.map_err(|e| e.of(device_of(settings)))? else { return Ok(()) };
    plan(&connectors, settings)
        .map(drop)
        .map_err(|e| TransportError::Unsuitable { device: device_of(settings), why: e.0 })
}

/// How the program starts the guardian of a display: the command without the display's own arguments.
static GUARDIAN: OnceLock<Vec<OsString>> = OnceLock::new();

/// Names the command that calls [`crate::card::show_black`]: the program and its first arguments. Without it a killed
/// program leaves its last frame to the kernel, which gives the display back to the console.
pub fn set_guardian(command: Vec<OsString>) {
    let _ = GUARDIAN.set(command);
}

/// A display that shows black, with its guardian.
struct OpenDisplay {
    shown: PanelOutput,
    guardian: Option<Guardian>,
}

/// The thread of a panel, and the cable to it.
struct PanelThread {
    host: HostEnd,
    counts: Arc<DisplayCounts>,
    thread: JoinHandle<()>,
    guardian: Option<Guardian>,
}

/// A display at the end of a link.
pub struct DisplayTransport {
    opener: Opener,
    policy: WaitPolicy,
    priority: u32,
    name: String,
    clock: Option<Arc<dyn HostClock>>,
    opened: Option<OpenDisplay>,
    line: Option<PanelThread>,
    opening: Option<Receiver<Result<OpenDisplay, TransportError>>>,
    warnings: Vec<String>,
}

fn open(opener: &Opener) -> Result<OpenDisplay, TransportError> {
    let mut shown = opener()?;
    let guardian = match guardian(shown.out.as_ref()) {
        Ok(guardian) => guardian,
        Err(e) => {
            shown
                .warnings
                .push(format!("cannot start the process that shows black if this run is killed: {e}"));
            None
        }
    };
    Ok(OpenDisplay { shown, guardian })
}

fn guardian(out: &dyn ScanOut) -> std::io::Result<Option<Guardian>> {
    let (Some((program, first)), Some((descriptor, arguments))) =
        (GUARDIAN.get().and_then(|command| command.split_first()), out.guarded())
    else {
        return Ok(None);
    };
    let mut command = Command::new(program);
    command.args(first).args(arguments).stdout(Stdio::from(descriptor));
    Guardian::start(command).map(Some)
}

impl DisplayTransport {
    /// Opens a display by `opener`, which shows black then. Its thread starts with the rig's clock; it rests by `policy`,
    /// under SCHED_FIFO at `priority` unless that is 0.
    ///
    /// # Errors
    /// The display is not there, or cannot be used as it was asked for: what is wrong, and what to do.
    pub fn open(opener: Opener, policy: WaitPolicy, priority: u32) -> Result<Self, TransportError> {
        let opened = open(&opener)?;
        let (name, warnings) = (opened.shown.name.clone(), opened.shown.warnings.clone());
        let (opened, clock, line, opening) = (Some(opened), None, None, None);
        Ok(Self { opener, policy, priority, name, clock, opened, line, opening, warnings })
    }

    /// What the operator should know.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// What the display did since its last start; `None` before the first.
    pub fn counts(&self) -> Option<Arc<DisplayCounts>> {
        self.line.as_ref().map(|line| line.counts.clone())
    }

    /// Starts the thread of a panel that was opened.
    fn run(&mut self, now: HostTime) {
        let Some(OpenDisplay { shown, guardian }) = self.opened.take() else { return };
        let clock = self.clock.get_or_insert_with(|| {
            // Nobody gave a clock: the caller's time goes on from here.
            let start = Instant::now();
            Arc::new(move || now.plus_ns(i64::try_from(start.elapsed().as_nanos()).unwrap_or(i64::MAX)))
        });
        let plane_bytes = packet_bytes(shown.panel.raster.plane_bytes());
        let frame_bytes = plane_bytes * shown.panel.planes + packet_bytes(COMMIT_BYTES);
        let (host, device) = threaded(frame_bytes, CABLE_BUFFERS, self.policy);
        let panel = DisplayPanel::new(shown.out, shown.panel, 0, clock.as_ref());
        let counts = panel.counts();
        let (clock, priority) = (clock.clone(), self.priority);
        let thread = std::thread::Builder::new().name("dpm-display".into()).spawn(move || {
            let _ = enter_frame_path(ThreadRights { priority, core: None });
            let _ = set_timer_slack_ns(1);
            serve(panel, device, clock.as_ref());
        });
        // Without a thread the cable has no far end, and the link says so.
        if let Ok(thread) = thread {
            self.line = Some(PanelThread { host, counts, thread, guardian });
        }
    }

    /// Why the line is dead.
    fn lost(&self) -> TransportError {
        let device = self.name.clone();
        match self.line.as_ref().and_then(|line| line.counts.lost()) {
            Some(why) if why != DisplayError::Gone.to_string() => TransportError::Unsuitable { device, why },
            _ => TransportError::Unplugged { device },
        }
    }

    /// Ends the thread, which shows black on its way out.
    fn end(&mut self) {
        let Some(PanelThread { host, thread, guardian, .. }) = self.line.take() else { return };
        drop(host);
        let limit = Instant::now() + END_WITHIN;
        while !thread.is_finished() && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(1));
        }
        // A thread that hangs has not shown black: then the guardian does when the process ends.
        match (thread.is_finished(), guardian) {
            (true, Some(guardian)) => guardian.dismiss(),
            (false, Some(guardian)) => std::mem::forget(guardian),
            _ => {}
        }
    }
}

/// Runs `panel` until the host's end of `cable` is dropped or the display is lost. Every way out is black.
fn serve(mut panel: DisplayPanel<Box<dyn ScanOut>>, mut cable: DeviceEnd, clock: &dyn HostClock) {
    while cable.serve(|| clock.now(), &mut panel) && !panel.is_lost() {
        panel.advance(clock.now());
        let limit = clock.now().plus_ns(REST_NS);
        cable.rest(panel.next_due().min(limit), || clock.now());
    }
}

impl Transport for DisplayTransport {
    fn send(
        &mut self,
        now: HostTime,
        lane: Lane,
        packets: &[dpm_device::link::Packet<'_>],
    ) -> Result<(), SendError> {
        self.run(now);
        let sent = match &mut self.line {
            Some(line) => line.host.send(now, lane, packets),
            None => return Err(SendError::Failed(self.lost())),
        };
        sent.map_err(|e| match e {
            SendError::Failed(_) => SendError::Failed(self.lost()),
            busy => busy,
        })
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        self.line.as_mut().is_none_or(|line| line.host.has_room(lane))
    }

    fn set_clock(&mut self, clock: Arc<dyn HostClock>) {
        let now = clock.now();
        self.clock.get_or_insert(clock);
        self.run(now);
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        self.run(now);
        match &mut self.line {
            Some(line) => line.host.receive(now, sink).map_err(|_| self.lost()),
            None => Err(self.lost()),
        }
    }

    fn reopen(&mut self) -> Result<(), TransportError> {
        self.end();
        if self.opened.is_some() {
            return Ok(());
        }
        // Setting a mode takes a second on some displays: a thread of its own does it.
        let Some(opening) = &self.opening else {
            let (done, opening) = channel();
            let opener = self.opener.clone();
            let started = std::thread::Builder::new().name("dpm-display-open".into()).spawn(move || {
                let _ = done.send(open(&opener));
            });
            if started.is_ok() {
                self.opening = Some(opening);
            }
            return Err(TransportError::Unplugged { device: self.name.clone() });
        };
        match opening.try_recv() {
            Ok(result) => {
                self.opening = None;
                self.opened = Some(result?);
                Ok(())
            }
            Err(TryRecvError::Empty) => Err(TransportError::Unplugged { device: self.name.clone() }),
            Err(TryRecvError::Disconnected) => {
                self.opening = None;
                Err(TransportError::Unplugged { device: self.name.clone() })
            }
        }
    }

    fn name(&self) -> &str {
        &self.name
    }
}

impl Drop for DisplayTransport {
    fn drop(&mut self) {
        self.end();
        if let Some(OpenDisplay { mut shown, guardian }) = self.opened.take() {
            shown.out.blacken();
            if let Some(guardian) = guardian {
                guardian.dismiss();
            }
        }
    }
}
