//! The protocol between a node and its ROS 2 side: frames over a local stream socket.
//!
//! A frame is its length (`u32`, little-endian) followed by the CDR bytes of a [`ToSide`] or a [`FromSide`].

use std::borrow::Cow;
use std::io::{self, ErrorKind, Read};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::Ros2Options;
use crate::bus::lifecycle::State;
use crate::bus::log::Severity;
use crate::bus::received::Counts;
use crate::msgs::{
    self, CdrError, DiagnosticArray, Heard, OperatingPoint, Prediction, RigInfo, Sensitivity, SessionEvent,
    Temperature, Vibration, Waveform,
};
use crate::system::clock::Reading;

/// Longest frame that the node accepts from its ROS 2 side, bytes.
pub(super) const MAX_FROM_SIDE: usize = 1 << 17;
/// Longest frame that the ROS 2 side accepts from its node, bytes.
pub(super) const MAX_TO_SIDE: usize = 1 << 24;
const LENGTH_BYTES: usize = 4;

/// What the node sends to its ROS 2 side.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum ToSide<'a> {
    /// The first frame.
    Start(Start),
    Prediction(Cow<'a, Prediction>),
    Rig(Cow<'a, RigInfo>),
    SessionEvent(Cow<'a, SessionEvent>),
    Sensitivity(Cow<'a, Sensitivity>),
    Diagnostics(Cow<'a, DiagnosticArray>),
    Heard(Cow<'a, Heard>),
    /// A line for `/rosout`.
    Log(Severity, Cow<'a, str>),
}

/// How the ROS 2 side joins the network.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Start {
    pub options: Ros2Options,
    /// Parameters and their present values.
    pub parameters: Vec<(String, f64)>,
    pub state: State,
}

/// What the ROS 2 side sends to its node.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum FromSide {
    /// It has joined the network under this full name.
    Joined(String),
    /// It cannot join the network, and why.
    Refused(String),
    Input {
        at: Reading,
        message: OperatingPoint,
    },
    Vibration {
        at: Reading,
        message: Vibration,
    },
    Temperature {
        at: Reading,
        message: Temperature,
    },
    Waveform {
        at: Reading,
        message: Waveform,
    },
    /// A peer set a parameter to a value that passed validation.
    Parameter {
        name: String,
        value: f64,
    },
    /// A peer brought the node into this state.
    Lifecycle(State),
    /// Sent regularly: its absence shows that the ROS 2 side hangs.
    Status(Status),
}

/// The state of the ROS 2 side.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Status {
    pub prediction_readers: u64,
    pub sensitivity_readers: u64,
    pub operating_point_writers: u64,
    pub counts: Counts,
    /// Counts of the blocks of samples.
    pub waveform_counts: Counts,
    /// Messages that DDS refused to publish, and the latest reason.
    pub refused: u64,
    pub last_refusal: String,
}

/// Why a frame could not be sent or understood.
#[derive(Debug, Error)]
pub(super) enum FrameError {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error("frame of {bytes} bytes, at most {limit} are accepted")]
    TooLong { bytes: usize, limit: usize },
    #[error("malformed frame: {0}")]
    Malformed(#[from] CdrError),
}

/// The bytes of a frame, its length included.
pub(super) fn encode(frame: &impl Serialize) -> Result<Vec<u8>, FrameError> {
    let mut bytes = vec![0; LENGTH_BYTES];
    bytes.append(&mut msgs::to_cdr(frame)?);
    let length = bytes.len() - LENGTH_BYTES;
    let too_long = |_| FrameError::TooLong { bytes: length, limit: u32::MAX as usize };
    bytes[..LENGTH_BYTES].copy_from_slice(&u32::try_from(length).map_err(too_long)?.to_le_bytes());
    Ok(bytes)
}

/// Result of reading a frame.
#[derive(Debug)]
pub(super) enum Next<F> {
    Frame(F),
    /// No whole frame came within the read timeout of the socket.
    Nothing,
    /// The other end closed the socket.
    End,
}

/// Reads frames from a socket.
pub(super) struct Frames<R> {
    from: R,
    limit: usize,
    /// Bytes read but not yet handed out, from `begin` on.
    bytes: Vec<u8>,
    begin: usize,
}

impl<R: Read> Frames<R> {
    /// Reads frames of up to `limit` bytes.
    pub(super) fn new(from: R, limit: usize) -> Self {
        Self { from, limit, bytes: Vec::new(), begin: 0 }
    }

    /// The next frame, waiting for no longer than the read timeout of the socket.
    ///
    /// # Errors
    /// A socket that fails, or a frame that is too long or malformed: the stream is of no further use.
    pub(super) fn next<F: DeserializeOwned>(&mut self) -> Result<Next<F>, FrameError> {
        if let Some(frame) = self.take()? {
            return Ok(Next::Frame(frame));
        }
        self.bytes.drain(..self.begin);
        self.begin = 0;
        let mut chunk = [0; 1 << 14];
        match self.from.read(&mut chunk) {
            Ok(0) => return Ok(Next::End),
            Ok(count) => self.bytes.extend_from_slice(&chunk[..count]),
            Err(error) => match error.kind() {
                ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted => return Ok(Next::Nothing),
                ErrorKind::ConnectionReset | ErrorKind::BrokenPipe => return Ok(Next::End),
                _ => return Err(error.into()),
            },
        }
        Ok(self.take()?.map_or(Next::Nothing, Next::Frame))
    }

    /// Takes a complete frame from the bytes already read.
    fn take<F: DeserializeOwned>(&mut self) -> Result<Option<F>, FrameError> {
        let waiting = &self.bytes[self.begin..];
        let Some((length, body)) = waiting.split_first_chunk::<LENGTH_BYTES>() else { return Ok(None) };
        let length = u32::from_le_bytes(*length) as usize;
        if length > self.limit {
            return Err(FrameError::TooLong { bytes: length, limit: self.limit });
        }
        let Some(body) = body.get(..length) else { return Ok(None) };
        let frame = msgs::from_cdr(body)?;
        self.begin += LENGTH_BYTES + length;
        Ok(Some(frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::{Header, Mode, Time};

    fn input(seq: u64) -> FromSide {
        let header = Header { stamp: Time::from_ns(-5), frame_id: "rig".to_owned() };
        let at = Reading { wall_ns: -3, monotonic_ns: u64::MAX };
        FromSide::Input {
            at,
            message: OperatingPoint { header, seq, friction_coefficient: f64::NAN, ..Default::default() },
        }
    }

    /// Delivers one byte at a time.
    struct Trickle<'a>(&'a [u8]);

    impl Read for Trickle<'_> {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            let count = self.0.len().min(1);
            buffer[..count].copy_from_slice(&self.0[..count]);
            self.0 = &self.0[count..];
            Ok(count)
        }
    }

    #[test]
    fn frames_come_out_as_they_went_in_however_they_are_cut() {
        let mut bytes = encode(&input(7)).expect("encoded");
        bytes.extend(encode(&FromSide::Status(Status { refused: 3, ..Default::default() })).expect("encoded"));
        let mut frames = Frames::new(Trickle(&bytes), MAX_FROM_SIDE);
        let mut next = || loop {
            match frames.next::<FromSide>().expect("well formed") {
                Next::Frame(frame) => break Some(format!("{frame:?}")),
                Next::Nothing => {}
                Next::End => break None,
            }
        };
        assert_eq!(next(), Some(format!("{:?}", input(7))));
        assert!(next().is_some_and(|status| status.contains("refused: 3")));
        assert_eq!(next(), None);
    }

    #[test]
    fn a_prediction_is_borrowed_to_be_sent_and_owned_when_it_came() {
        let prediction = Prediction { input_seq: 9, modes: vec![Mode::default(); 64], ..Default::default() };
        let bytes = encode(&ToSide::Prediction(Cow::Borrowed(&prediction))).expect("encoded");
        let Ok(Next::Frame(ToSide::Prediction(got))) = Frames::new(&bytes[..], MAX_TO_SIDE).next::<ToSide>() else {
            panic!("another frame");
        };
        assert_eq!(*got, prediction);
    }

    #[test]
    fn a_frame_that_is_too_long_or_malformed_is_an_error_and_allocates_nothing() {
        let mut bytes = ((MAX_FROM_SIDE + 1) as u32).to_le_bytes().to_vec();
        let result = Frames::new(&bytes[..], MAX_FROM_SIDE).next::<FromSide>();
        assert!(matches!(result, Err(FrameError::TooLong { .. })), "{result:?}");
        bytes = [&8u32.to_le_bytes()[..], &[0, 1, 0, 0, 99, 0, 0, 0]].concat();
        let result = Frames::new(&bytes[..], MAX_FROM_SIDE).next::<FromSide>();
        assert!(matches!(result, Err(FrameError::Malformed(_))), "{result:?}");
    }
}
