//! What must hold of every packet and every report of a device, whatever it was asked.

use dpm_device::link::{DeviceMessage, DeviceState, Header, MessageType, PayloadError, Status};

/// First breach of each law, and how much it was tried on.
#[derive(Clone, Debug, Default)]
pub(super) struct Laws {
    /// Reports seen.
    pub reports: u64,
    /// `slots = lit + repeated + blank`.
    pub slots: Option<String>,
    /// `seen = lit + incomplete + late + superseded + refused` and those on their way.
    pub seen: Option<String>,
    /// `limit = accounted + free`, or `accounted` while not armed.
    pub credit: Option<String>,
    /// The clock never goes back.
    pub clock: Option<String>,
    /// Light only in armed and frozen.
    pub dark: Option<String>,
    /// Packets are as section 2 says.
    pub packets: Option<String>,
    last_tick: u64,
    buffers: Option<u32>,
}

fn first(of: &mut Option<String>, told: impl FnOnce() -> String) {
    of.get_or_insert_with(told);
}

impl Laws {
    /// A packet's header.
    pub(super) fn header(&mut self, h: &Header) {
        let from_device = matches!(
            h.kind,
            MessageType::Hello | MessageType::Status | MessageType::Echo | MessageType::Fault
        );
        if !from_device {
            first(&mut self.packets, || format!("{:?}, which only a host sends", h.kind));
        } else if h.plane != 0 || h.frame != 0 || h.target_at.0 != 0 || h.led_code != 0 || h.codec as u8 != 0
        {
            first(&mut self.packets, || {
                format!("{:?} with a flag, plane, frame, target or LED code that is not 0", h.kind)
            });
        }
    }

    /// A payload that cannot be read.
    pub(super) fn unreadable(&mut self, e: &PayloadError) {
        first(&mut self.packets, || e.to_string());
    }

    /// A message.
    pub(super) fn message(&mut self, message: &DeviceMessage) {
        match message {
            DeviceMessage::Hello(h) => {
                self.buffers = Some(u32::from(h.frame_buffers));
                self.tick(h.now.0, "HELLO");
            }
            DeviceMessage::Status(s) => {
                self.tick(s.now.0, "STATUS");
                self.status(s);
            }
            DeviceMessage::Echo(e) => {
                if e.device_sent < e.device_received {
                    first(&mut self.clock, || {
                        format!(
                            "an ECHO that left at {} before it arrived at {}",
                            e.device_sent.0, e.device_received.0
                        )
                    });
                }
                // Echoes may overtake reports, so only reports are held against each other.
            }
            DeviceMessage::Fault(_) => {}
        }
    }

    fn tick(&mut self, now: u64, of: &str) {
        let last = self.last_tick;
        if now < last {
            first(&mut self.clock, || format!("{of} of tick {now} after one of tick {last}"));
        }
        self.last_tick = now;
    }

    fn status(&mut self, s: &Status) {
        self.reports += 1;
        let sum = s.frames_lit.wrapping_add(s.slots_repeated).wrapping_add(s.slots_blank);
        if s.slots != sum {
            first(&mut self.slots, || {
                format!(
                    "{} slots, {} lit + {} repeated + {} blank",
                    s.slots, s.frames_lit, s.slots_repeated, s.slots_blank
                )
            });
        }
        let ended = [s.frames_lit, s.frames_incomplete, s.frames_late, s.frames_superseded, s.frames_refused];
        let under_way = s.frames_seen.wrapping_sub(ended.iter().fold(0u32, |sum, n| sum.wrapping_add(*n)));
        // Those that wait in buffers, and one that is arriving.
        // Before the first HELLO nobody knows how many buffers there are.
        let Some(buffers) = self.buffers else { return };
        let waiting = buffers.saturating_sub(u32::from(s.buffers_free));
        if under_way > waiting + 1 || under_way < waiting {
            first(&mut self.seen, || {
                format!(
                    "{} frames seen, {} of them lit, incomplete, late, superseded or refused: {} under way with {waiting} of {buffers} buffers in use",
                    s.frames_seen,
                    s.frames_seen.wrapping_sub(under_way),
                    under_way as i32
                )
            });
        }
        let is_armed = matches!(s.state, DeviceState::Armed | DeviceState::Black | DeviceState::Frozen);
        let free = if is_armed { u32::from(s.buffers_free) } else { 0 };
        if s.frame_limit != s.frames_accounted.wrapping_add(free) || u32::from(s.buffers_free) > buffers {
            first(&mut self.credit, || {
                format!(
                    "{:?}: limit {}, {} accounted, {} of {buffers} buffers free",
                    s.state, s.frame_limit, s.frames_accounted, s.buffers_free
                )
            });
        }
        if s.lit && !matches!(s.state, DeviceState::Armed | DeviceState::Frozen) {
            first(&mut self.dark, || format!("light on in state {:?}", s.state));
        }
    }
}
