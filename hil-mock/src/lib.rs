//! A projector and a tracker made of software: the same mock in-process, over USB/IP, pseudo-terminals and UDP.

pub mod usb_model;
pub mod usb_plug;
