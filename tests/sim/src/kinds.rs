//! The kinds of faults, and the states of the rig in which they strike.

use crate::plan::TrackerKind;

/// What the rig is doing, as an operator would say.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(usize)]
pub enum State {
    /// No process runs, or it prepares its GPU.
    Dark,
    /// The link comes up.
    Arming,
    /// Frames are shown.
    Running,
    /// The medium is gone.
    RePlugging,
    /// The operator ordered BLACK or FREEZE.
    FrozenOrBlack,
    /// A stop was asked for.
    ShuttingDown,
    /// The projector has latched a fault, or light rests.
    Faulted,
}

impl State {
    /// All states.
    pub const ALL: [Self; 7] = [
        Self::Dark,
        Self::Arming,
        Self::Running,
        Self::RePlugging,
        Self::FrozenOrBlack,
        Self::ShuttingDown,
        Self::Faulted,
    ];

    /// As printed.
    pub fn word(self) -> &'static str {
        ["dark", "arming", "running", "re-plug", "frozen/black", "shutdown", "faulted"][self as usize]
    }
}

/// Declares the kinds with their names and texts.
macro_rules! kinds {
    ($($(#[doc = $doc:literal])+ $kind:ident,)+) => {
        /// A kind of fault. The letters and numbers are those of docs/FAILURES.md; X are kinds that were found later.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[repr(usize)]
        pub enum Kind { $($(#[doc = $doc])+ $kind,)+ }

        impl Kind {
            /// All kinds.
            pub const ALL: &'static [Self] = &[$(Self::$kind),+];

            /// What it is.
            pub fn text(self) -> &'static str {
                match self { $(Self::$kind => concat!($($doc),+).trim_ascii(),)+ }
            }
        }
    };
}

kinds! {
    /// The tracker loses two or three samples.
    T1,
    /// The tracker is silent for 0.1 to 2 s.
    T2,
    /// The tracker is intermittent.
    T3,
    /// The tracker repeats one pose under new numbers.
    T4,
    /// The tracker reports that it does not see the body.
    T5,
    /// A pose jumps.
    T6,
    /// Coordinates are NaN, infinite or huge.
    T7,
    /// Quaternions have a wrong length or the other sign.
    T8,
    /// Datagrams arrive twice.
    T9,
    /// Datagrams overtake each other or are late.
    T10,
    /// The tracker's program restarts: numbers and clock begin anew.
    T11,
    /// The body has another name and number.
    T12,
    /// Datagrams are cut short or damaged.
    T13,
    /// The server's protocol version changes.
    T14,
    /// The tracker's rate changes, or samples arrive in bursts.
    T15,
    /// Strangers send to the host's socket.
    T16,
    /// The tracker reports millimetres.
    T17,
    /// A serial tracker's line is noisy or unplugged.
    T18,
    /// The projector is unplugged.
    U1,
    /// It is unplugged with frames on the cable.
    U2,
    /// An endpoint is halted for 1 to 300 ms.
    U3,
    /// The cable is slower than the frames.
    U4,
    /// Transfers end too early.
    U5,
    /// Replies are damaged or too long.
    U6,
    /// Packets are damaged or lost.
    U7,
    /// The projector forgets everything.
    U8,
    /// Another projector, with another panel, is in its place.
    U9,
    /// Old replies arrive again.
    U10,
    /// The projector's clock jumps.
    U11,
    /// The projector is too hot, its lamp fails, or its emergency stop is pressed.
    U12,
    /// Another host speaks to the projector.
    U13,
    /// The port may not be opened.
    U14,
    /// The program is killed.
    U15,
    /// There is no GPU at the next start.
    G1,
    /// The GPU's memory does not suffice at the next start.
    G2,
    /// The GPU's memory does not suffice for a new scene.
    G3,
    /// The GPU is lost.
    G4,
    /// The GPU never finishes a frame.
    G5,
    /// One dispatch takes 0.3 to 1.5 s.
    G6,
    /// A frame is late.
    G7,
    /// Pixels are NaN.
    G8,
    /// A cache of shaders is damaged.
    G9,
    /// The disk is full or slow.
    H1,
    /// The program is killed while it writes an order down.
    H2,
    /// The machine is suspended, or its wall clock is set.
    H3,
    /// A stage stalls for 1 ms to 1 s.
    H4,
    /// A stage panics.
    H5,
    /// The program is asked to stop, once or twice.
    H6,
    /// The rig file is wrong at the next start.
    H7,
    /// The stages wake late: no real-time priority.
    H8,
    /// The machine has one core for everything.
    H9,
    /// No descriptors are left.
    H10,
    /// A second instance is started.
    H11,
    /// Counts, offsets or strides of a scene near the limits of integers.
    F1,
    /// Accessors of a scene beyond their buffers.
    F2,
    /// Nodes of a scene in a circle.
    F3,
    /// Indices beyond the vertices; vertices that are NaN.
    F4,
    /// A million copies of a mesh.
    F5,
    /// A texture that decompresses to gigabytes.
    F6,
    /// Addresses outside the scene's folder.
    F7,
    /// Data addresses and containers that lie about their length.
    F8,
    /// Required extensions that nobody knows.
    F9,
    /// Lights, cameras and matrices that are no numbers.
    F10,
    /// A flood of datagrams.
    N1,
    /// Datagrams of the greatest size.
    N2,
    /// A client of the control socket that sends a byte a second.
    N3,
    /// A control message that announces gigabytes.
    N4,
    /// A storm of connections to the control socket.
    N5,
    /// Old datagrams of the tracker arrive again.
    N6,
    /// Forged datagrams with the tracker's address.
    N7,
    /// A stage never returns.
    X1,
    /// A stage never returns, and then a stop is asked for.
    X2,
    /// SAFE, then the program is killed.
    X3,
    /// The program is restarted in order while the projector stays on.
    X4,
    /// Orders in quick succession.
    X5,
    /// The program is stopped and continued (SIGSTOP).
    X6,
    /// The tracker falls silent while the GPU hangs.
    X7,
    /// The control lane is late: tracks arrive when they are old.
    X8,
    /// A serial line echoes: one of its ends hears itself.
    X9,
    /// A serial line is silent both ways, while its port stays open.
    X10,
    /// The ends of a serial line run at different rates: every byte is another one.
    X11,
    /// A VRPN server resets its connection, and refuses others for a while.
    X12,
    /// A VRPN connection is half-open: the server's machine was restarted and has forgotten it.
    X13,
    /// Nothing gets through between a VRPN server and the host, and later all of it.
    X14,
    /// A VRPN server hangs: it accepts and says nothing, or something else listens at its port.
    X15,
    /// The clock of a VRPN server is set while it runs.
    X16,
    /// A queue stands between the stages, which are slower the more frames are under way.
    X17,
    /// The cable carries only every second to sixth frame, for seconds.
    X18,
    /// The interlock opens, chatters, or hangs.
    X19,
    /// Somebody sends OSC, who may or may not.
    X20,
    /// One call to the disk fails, the first to the sixth from now.
    X21,
    /// The cable loses orders to go dark, the first few or all for a while, and nothing else.
    X22,
    /// The projector latches a fault, and then an ARM arrives that acknowledges nothing.
    X23,
    /// An order to go dark while the light rests.
    X24,
    /// The tracker does not see the glasses, and sees the rest.
    X25,
    /// The tracker exchanges the labels of the glasses and of the body.
    X26,
    /// One call to the tracker's socket, connection or port fails.
    X27,
    /// One call to the projector's cable fails.
    X28,
}

const FILES: &str = "scenes are read only when the program starts, before any light";

impl Kind {
    /// It strikes the tracker or its network, and nothing else.
    pub fn is_of_tracker(self) -> bool {
        (self as usize) <= Self::T18 as usize
            || self.needs_connection()
            || matches!(self, Self::X25 | Self::X26 | Self::X27)
    }

    /// It strikes only where the tracker is a VRPN server.
    pub fn needs_connection(self) -> bool {
        matches!(self, Self::X12 | Self::X13 | Self::X14 | Self::X15 | Self::X16)
    }

    /// It can strike a life with a tracker of this kind: only NatNet has datagrams, which strangers can send, too.
    pub fn strikes(self, tracker: TrackerKind) -> bool {
        match self {
            Self::T18 => tracker == TrackerKind::Serial,
            Self::T16 | Self::N1 | Self::N2 | Self::N6 | Self::N7 => tracker == TrackerKind::NatNet,
            _ => !self.needs_connection() || tracker == TrackerKind::Vrpn,
        }
    }

    /// It strikes only where the projector follows tracks.
    pub fn needs_tracks(self) -> bool {
        self == Self::X8
    }

    /// It strikes only where a guard stands alone that has to answer it.
    pub fn needs_guard(self) -> bool {
        matches!(self, Self::X19 | Self::X20 | Self::X21 | Self::X22 | Self::X23 | Self::X24)
            || matches!(self, Self::X25 | Self::X26)
    }

    /// It strikes only lives of their own, see [`crate::plan::Setup::flaky`].
    pub fn needs_flakiness(self) -> bool {
        matches!(self, Self::X27 | Self::X28)
    }

    /// It strikes only where the projector hangs on a serial line.
    pub fn needs_line(self) -> bool {
        matches!(self, Self::X9 | Self::X10 | Self::X11)
    }

    /// It strikes only lives of their own, see [`crate::plan::Setup::strained`].
    pub fn needs_strain(self) -> bool {
        matches!(self, Self::X17 | Self::X18)
    }

    /// Why nothing of this kind happens in the world although it strikes; `None` if something does. Such strikes are counted
    /// apart, and fill no cell.
    pub fn stands_in(self) -> Option<&'static str> {
        use Kind as K;
        match self {
            K::H11 => Some("the lock that refuses a second instance is not in it"),
            K::N3 | K::N4 | K::N5 => Some("the control socket is not in it: stages only take longer"),
            K::G8 => Some("pixels are not in it"),
            K::F1 | K::F2 | K::F3 | K::F4 | K::F5 | K::F6 | K::F7 | K::F8 | K::F9 | K::F10 => {
                Some("what reads scenes is not in it: the next start is refused, as for H7")
            }
            _ => None,
        }
    }

    /// Why this kind cannot strike in `state`; `None` if it can.
    pub fn impossible(self, state: State) -> Option<&'static str> {
        use Kind as K;
        match self {
            K::G3 => Some("no scene is loaded while the rig runs"),
            K::G9 => Some("the program keeps no cache of shaders"),
            K::F1 | K::F2 | K::F3 | K::F4 | K::F5 | K::F6 | K::F7 | K::F8 | K::F9 | K::F10 => {
                (state != State::Dark).then_some(FILES)
            }
            K::X17 | K::X18 => (state != State::Running).then_some("it strikes frames that are shown"),
            K::X24 => matches!(state, State::Dark | State::FrozenOrBlack | State::ShuttingDown)
                .then_some("light rests only where there was some"),
            K::H7 | K::G1 | K::G2 => {
                (state != State::Dark).then_some("it strikes only when the program starts")
            }
            _ => None,
        }
    }
}
