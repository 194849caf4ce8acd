//! The numbers and structs of the ALP API that this driver uses. `docs/ALP.md` says by which kind of source each was confirmed.
//!
//! On Linux every integer of the interface has 32 bits, and structs have no padding.

/// Success.
pub(super) const OK: i32 = 0;
pub(super) const NOT_ONLINE: i32 = 1001;
pub(super) const NOT_IDLE: i32 = 1002;
pub(super) const NOT_AVAILABLE: i32 = 1003;
pub(super) const ERROR_COMM: i32 = 1011;
pub(super) const DEVICE_REMOVED: i32 = 1012;

/// The first free device, and no particular value.
pub(super) const DEFAULT: i32 = 0;

// Properties of a device.
pub(super) const DEVICE_NUMBER: i32 = 2000;
pub(super) const VERSION: i32 = 2001;
pub(super) const AVAIL_MEMORY: i32 = 2003;
pub(super) const DEV_DMDTYPE: i32 = 2021;
pub(super) const DDC_FPGA_TEMPERATURE: i32 = 2050;
pub(super) const APPS_FPGA_TEMPERATURE: i32 = 2051;
pub(super) const PCB_TEMPERATURE: i32 = 2052;
pub(super) const DEV_DISPLAY_HEIGHT: i32 = 2057;
pub(super) const DEV_DISPLAY_WIDTH: i32 = 2058;
pub(super) const MAX_DDC_FPGA_TEMPERATURE: i32 = 2145;
pub(super) const MAX_APPS_FPGA_TEMPERATURE: i32 = 2146;
pub(super) const MAX_PCB_TEMPERATURE: i32 = 2147;
pub(super) const USB_DISCONNECT_BEHAVIOUR: i32 = 2078;
pub(super) const USB_RESET: i32 = 2;

// Properties of a sequence.
pub(super) const SEQ_REPEAT: i32 = 2100;
pub(super) const BIN_MODE: i32 = 2104;
pub(super) const BIN_UNINTERRUPTED: i32 = 2106;
pub(super) const DATA_FORMAT: i32 = 2110;
pub(super) const DATA_BINARY_TOPDOWN: i32 = 2;
pub(super) const PICTURE_TIME: i32 = 2203;
pub(super) const MIN_PICTURE_TIME: i32 = 2211;
pub(super) const MAX_PICTURE_TIME: i32 = 2213;

// Properties of the projection.
pub(super) const PROJ_QUEUE_MODE: i32 = 2314;
pub(super) const PROJ_SEQUENCE_QUEUE: i32 = 1;
pub(super) const PROJ_QUEUE_MAX_AVAIL: i32 = 2316;
pub(super) const PROJ_PROGRESS: i32 = 2318;
pub(super) const PROJ_RESET_QUEUE: i32 = 2319;
pub(super) const PROJ_ABORT_SEQUENCE: i32 = 2320;
pub(super) const PROJ_ABORT_FRAME: i32 = 2321;
pub(super) const PROJ_ABORT_ASYNC: i32 = 2345;
pub(super) const PROJ_STATE: i32 = 2400;
pub(super) const PROJ_ACTIVE: i32 = 1200;

/// A flag of [`RawProgress::flags`]: nothing is shown.
pub(super) const FLAG_QUEUE_IDLE: u32 = 1;

/// `tAlpProjProgress`.
#[repr(C, packed)]
#[derive(Clone, Copy, Default)]
pub(super) struct RawProgress {
    pub(super) queue_id: u32,
    pub(super) sequence: u32,
    pub(super) waiting: u32,
    pub(super) runs: u32,
    pub(super) underflow: u32,
    pub(super) pictures: u32,
    pub(super) picture_us: u32,
    pub(super) pictures_of_run: u32,
    pub(super) flags: u32,
}

/// The vendor's name of a return code.
pub(super) fn name_of(code: i32) -> &'static str {
    match code {
        0 => "ALP_OK",
        1001 => "ALP_NOT_ONLINE",
        1002 => "ALP_NOT_IDLE",
        1003 => "ALP_NOT_AVAILABLE",
        1004 => "ALP_NOT_READY",
        1005 => "ALP_PARM_INVALID",
        1006 => "ALP_ADDR_INVALID",
        1007 => "ALP_MEMORY_FULL",
        1008 => "ALP_SEQ_IN_USE",
        1009 => "ALP_HALTED",
        1010 => "ALP_ERROR_INIT",
        1011 => "ALP_ERROR_COMM",
        1012 => "ALP_DEVICE_REMOVED",
        1013 => "ALP_NOT_CONFIGURED",
        1014 => "ALP_LOADER_VERSION",
        1018 => "ALP_ERROR_POWER_DOWN",
        1019 => "ALP_DRIVER_VERSION",
        1020 => "ALP_SDRAM_INIT",
        1021 => "ALP_CONFIG_MISMATCH",
        _ => "an unknown code",
    }
}

/// The panel of a DMD type.
pub(super) fn panel_name(dmd_type: i32) -> &'static str {
    match dmd_type {
        1 => "XGA 0.7 inch (D3000)",
        2 => "SXGA+ 0.95 inch",
        3 => "1080p 0.95 inch (DLP9500)",
        4 => "XGA 0.7 inch (DLP7000)",
        5 => "XGA 0.55 inch, type A",
        6 => "XGA 0.55 inch, type X",
        7 => "WUXGA 0.96 inch",
        8 | 9 => "WQXGA 0.9 inch (DLP9000X)",
        10 => "1080p 0.65 inch (DLP6500FLQ)",
        11 => "1080p 0.65 inch (DLP6500FYE)",
        12 => "WXGA 0.65 inch (DLP650LNIR)",
        _ => "unknown panel",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A struct of 64-bit words, as the old headers' `long` would make it on Linux, is written wrongly without an error.
    #[test]
    fn structs_have_the_sizes_of_the_linux_library() {
        assert_eq!(size_of::<RawProgress>(), 9 * 4);
    }
}
