//! Numbers of the ALP API that the fake knows. They are typed a second time here, apart from those of the driver, so that a slip in one of
//! the two is noticed.

/// Success.
pub const OK: i32 = 0;
/// No such device, or it is not ready.
pub const NOT_ONLINE: i32 = 1001;
/// Something is being shown.
pub const NOT_IDLE: i32 = 1002;
/// The device's identifier is not valid.
pub const NOT_AVAILABLE: i32 = 1003;
/// The device is allocated already, or another call uses it.
pub const NOT_READY: i32 = 1004;
/// A parameter is not valid.
pub const PARM_INVALID: i32 = 1005;
/// The user's data cannot be read or written.
pub const ADDR_INVALID: i32 = 1006;
/// The memory does not suffice.
pub const MEMORY_FULL: i32 = 1007;
/// The sequence is being shown or waits to be.
pub const SEQ_IN_USE: i32 = 1008;
/// The device was stopped while data were transferred.
pub const HALTED: i32 = 1009;
/// Initialisation failed.
pub const ERROR_INIT: i32 = 1010;
/// Communication failed.
pub const ERROR_COMM: i32 = 1011;
/// The device is gone.
pub const DEVICE_REMOVED: i32 = 1012;
/// The device is not set up for these parameters.
pub const CONFIG_MISMATCH: i32 = 1021;
/// Anything else.
pub const ERROR_UNKNOWN: i32 = 1999;

/// No identifier.
pub const INVALID_ID: u32 = u32::MAX;

pub(crate) const DEV_BUSY: i32 = 1100;
pub(crate) const DEV_IDLE: i32 = 1102;
pub(crate) const PROJ_ACTIVE: i32 = 1200;
pub(crate) const PROJ_IDLE: i32 = 1201;

pub(crate) const DEVICE_NUMBER: i32 = 2000;
pub(crate) const VERSION: i32 = 2001;
pub(crate) const DEV_STATE: i32 = 2002;
pub(crate) const AVAIL_MEMORY: i32 = 2003;
pub(crate) const DEV_DMDTYPE: i32 = 2021;
pub(crate) const DDC_FPGA_TEMPERATURE: i32 = 2050;
pub(crate) const APPS_FPGA_TEMPERATURE: i32 = 2051;
pub(crate) const PCB_TEMPERATURE: i32 = 2052;
pub(crate) const DISPLAY_HEIGHT: i32 = 2057;
pub(crate) const DISPLAY_WIDTH: i32 = 2058;
pub(crate) const USB_DISCONNECT_BEHAVIOUR: i32 = 2078;
pub(crate) const USB_IGNORE: i32 = 1;
pub(crate) const USB_RESET: i32 = 2;

pub(crate) const SEQ_REPEAT: i32 = 2100;
pub(crate) const FIRSTFRAME: i32 = 2101;
pub(crate) const LASTFRAME: i32 = 2102;
pub(crate) const BITNUM: i32 = 2103;
pub(crate) const BIN_MODE: i32 = 2104;
pub(crate) const BIN_NORMAL: i32 = 2105;
pub(crate) const BIN_UNINTERRUPTED: i32 = 2106;
pub(crate) const DATA_FORMAT: i32 = 2110;
pub(crate) const DATA_BINARY_TOPDOWN: i32 = 2;
pub(crate) const SEQ_PUT_LOCK: i32 = 2119;
pub(crate) const BITPLANES: i32 = 2200;
pub(crate) const PICNUM: i32 = 2201;
pub(crate) const PICTURE_TIME: i32 = 2203;
pub(crate) const ILLUMINATE_TIME: i32 = 2204;
pub(crate) const MIN_PICTURE_TIME: i32 = 2211;
pub(crate) const MIN_ILLUMINATE_TIME: i32 = 2212;
pub(crate) const MAX_PICTURE_TIME: i32 = 2213;

pub(crate) const PROJ_QUEUE_MODE: i32 = 2314;
pub(crate) const PROJ_LEGACY: i32 = 0;
pub(crate) const PROJ_SEQUENCE_QUEUE: i32 = 1;
pub(crate) const PROJ_QUEUE_ID: i32 = 2315;
pub(crate) const PROJ_QUEUE_MAX_AVAIL: i32 = 2316;
pub(crate) const PROJ_QUEUE_AVAIL: i32 = 2317;
pub(crate) const PROJ_PROGRESS: i32 = 2318;
pub(crate) const PROJ_RESET_QUEUE: i32 = 2319;
pub(crate) const PROJ_ABORT_SEQUENCE: i32 = 2320;
pub(crate) const PROJ_ABORT_FRAME: i32 = 2321;
pub(crate) const PROJ_ABORT_ASYNC: i32 = 2345;
pub(crate) const PROJ_STATE: i32 = 2400;

pub(crate) const FLAG_QUEUE_IDLE: u32 = 1;
pub(crate) const FLAG_SEQUENCE_ABORTING: u32 = 2;
pub(crate) const FLAG_SEQUENCE_INDEFINITE: u32 = 4;
