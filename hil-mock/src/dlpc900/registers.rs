//! Commands that only store and return a value: their sizes and reset values. \[DLPU018 table A-1\]

use dpm_dlpc900::command::Opcode;
use dpm_dlpc900::sequence::Version;

/// Size and reset value of a plain setting; `None` when the opcode is not one.
pub(super) fn setting(opcode: Opcode, firmware: Version) -> Option<Vec<u8>> {
    Some(match opcode {
        Opcode::GPIO_CLOCK => vec![0; 3],
        Opcode::LED_CURRENT => vec![0x97, 0x78, 0x7d],
        Opcode::DISPLAY_RESOLUTION => vec![0; 16],
        Opcode::FLIP_LONG | Opcode::FLIP_SHORT => vec![0],
        Opcode::CURTAIN => vec![0; 6],
        Opcode::TEST_PATTERN => vec![0],
        Opcode::TEST_COLOUR => vec![0; 12],
        Opcode::INPUT_SOURCE => vec![0x08],
        Opcode::RECEIVER => vec![0],
        Opcode::PIXEL_FORMAT => vec![0],
        Opcode::PORT_CLOCK => vec![0],
        Opcode::LED_POLARITY => vec![0],
        Opcode::LED_ENABLE => vec![0x08],
        Opcode::BATCH_NAME => vec![0; 32],
        Opcode::BATCH_DELAY => vec![0; 4],
        Opcode::PWM_ENABLE => vec![0],
        Opcode::PWM_SETUP => vec![0; 6],
        Opcode::TRIG_OUT1 | Opcode::TRIG_OUT2 => vec![0; 5],
        // A rising and a falling delay; firmware 6 put a byte before them, which broke every older program.
        Opcode::RED_DELAY | Opcode::GREEN_DELAY | Opcode::BLUE_DELAY => {
            vec![0; if firmware.major >= 6 { 5 } else { 4 }]
        }
        Opcode::STANDBY_DELAY => vec![0; 2],
        Opcode::INVERT => vec![0],
        Opcode::TRIG_IN1 => vec![105, 0, 0],
        Opcode::TRIG_IN2 => vec![0],
        Opcode::CHANNEL_SWAP => vec![0x08],
        Opcode::GPIO => vec![0],
        Opcode::INPUT_EXTRA => vec![0],
        Opcode::GAMMA => vec![0],
        Opcode::INPUT_CONFIG => vec![0; 2],
        Opcode::BLOCK_LOAD => vec![0, 15],
        Opcode::MIN_LED_PULSE_US | Opcode::MIN_LED_PULSE_NS => vec![0; 4],
        Opcode::I2C_CONFIG => vec![0; 3],
        _ => return None,
    })
}

/// Settings whose length the sources leave open: any length from 1 to this many bytes is accepted.
pub(super) fn is_loose(opcode: Opcode) -> bool {
    matches!(
        opcode,
        Opcode::GPIO_CLOCK
            | Opcode::TEST_COLOUR
            | Opcode::BATCH_NAME
            | Opcode::BATCH_DELAY
            | Opcode::PWM_SETUP
            | Opcode::STANDBY_DELAY
            | Opcode::TRIG_IN1
            | Opcode::GPIO
            | Opcode::INPUT_CONFIG
            | Opcode::MIN_LED_PULSE_US
            | Opcode::MIN_LED_PULSE_NS
            | Opcode::I2C_CONFIG
    )
}
