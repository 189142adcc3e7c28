//! A recording, played for Foxglove, whose playback bar plays, pauses and seeks in it.

use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use foxglove::WebSocketServerHandle;
use foxglove::websocket::{
    Capability, PlaybackCommand, PlaybackControlRequest, PlaybackState, PlaybackStatus, ServerListener,
};

use super::{Channels, ServerError, is_shown};
use crate::msgs::schema::Topic;
use crate::recording::reader::{Entry, Messages, Recorded, Recording};

/// Interval at which due messages are sent.
const TICK: Duration = Duration::from_millis(10);
/// Slowest and fastest speed, in parts of real time.
const SPEEDS: RangeInclusive<f32> = 0.001..=1000.0;

/// Why a recording cannot be played for Foxglove.
#[derive(Debug, thiserror::Error)]
pub enum PlaybackError {
    #[error("the recording is empty")]
    Empty,
    #[error(transparent)]
    Server(#[from] ServerError),
}

/// Serves one recording.
pub struct Playback {
    channels: Channels,
    control: Arc<Control>,
    server: Option<WebSocketServerHandle>,
}

/// The state of the player, which clients change.
struct Control {
    /// Recorded times of the first and last message, ns.
    span: RangeInclusive<u64>,
    state: Mutex<State>,
}

#[derive(Clone, Copy)]
struct State {
    playing: bool,
    speed: f32,
    position_ns: u64,
    /// Whether the position was changed by a client since the last tick.
    sought: bool,
}

impl Control {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The state in the words of the protocol.
    fn said(&self, state: State, did_seek: bool, request_id: Option<String>) -> PlaybackState {
        let status = match state.playing {
            true => PlaybackStatus::Playing,
            false if state.position_ns >= *self.span.end() => PlaybackStatus::Ended,
            false => PlaybackStatus::Paused,
        };
        let (current_time, playback_speed) = (state.position_ns, state.speed);
        PlaybackState { status, current_time, playback_speed, did_seek, request_id }
    }
}

impl ServerListener for Control {
    fn on_playback_control_request(&self, request: PlaybackControlRequest) -> Option<PlaybackState> {
        let mut state = self.state();
        state.playing = request.playback_command == PlaybackCommand::Play;
        if request.playback_speed.is_finite() {
            state.speed = request.playback_speed.clamp(*SPEEDS.start(), *SPEEDS.end());
        }
        if let Some(to_ns) = request.seek_time {
            (state.position_ns, state.sought) = (to_ns.clamp(*self.span.start(), *self.span.end()), true);
        } else if state.playing && state.position_ns >= *self.span.end() {
            // Played again from the start.
            (state.position_ns, state.sought) = (*self.span.start(), true);
        }
        Some(self.said(*state, request.seek_time.is_some(), Some(request.request_id)))
    }
}

impl Playback {
    /// Starts the server for a recording, which it plays from the start.
    ///
    /// # Errors
    /// A recording without messages; the address is taken.
    pub fn start(address: SocketAddr, name: &str, recording: &Recording) -> Result<Self, PlaybackError> {
        let failed = |source| ServerError { address, source };
        let mut times = recording.messages().map(|entry| entry.log_time_ns);
        let first = times.next().ok_or(PlaybackError::Empty)?;
        let span = first..=times.fold(first, u64::max);
        let state = State { playing: true, speed: 1.0, position_ns: first, sought: true };
        let control = Arc::new(Control { span, state: Mutex::new(state) });
        let channels = Channels::open().map_err(failed)?;
        let server = channels
            .server(name, address)
            .capabilities([Capability::Time])
            .playback_time_range(*control.span.start(), *control.span.end())
            .listener(control.clone())
            .start_blocking()
            .map_err(failed)?;
        Ok(Self { channels, control, server: Some(server) })
    }

    /// The port it listens to.
    pub fn port(&self) -> u16 {
        self.server.as_ref().map_or(0, WebSocketServerHandle::port)
    }

    /// Plays as the clients wish, until `stopped`.
    pub fn run(&self, recording: &Recording, stopped: &AtomicBool) {
        let mut playing = Playing { messages: recording.messages(), next: None };
        let mut ticked = Instant::now();
        while !stopped.load(Ordering::Relaxed) {
            std::thread::sleep(TICK);
            let passed = ticked.elapsed();
            ticked = Instant::now();
            let (state, ended) = self.advance(passed);
            if state.sought {
                let rest = state.position_ns..=*self.control.span.end();
                playing = Playing { messages: recording.messages_around(rest), next: None };
                playing.skip_before(state.position_ns);
            }
            if state.playing || ended {
                playing.send_until(state.position_ns, &self.channels);
            }
            if let Some(server) = self.server.as_ref().filter(|_| state.playing || state.sought || ended) {
                server.broadcast_time(state.position_ns);
                if ended {
                    server.broadcast_playback_state(self.control.said(*self.control.state(), false, None));
                }
            }
        }
    }

    /// Moves on by the time that has passed. Returns the state, and whether it has just reached the end.
    fn advance(&self, passed: Duration) -> (State, bool) {
        let mut state = self.control.state();
        let end_ns = *self.control.span.end();
        let mut ended = false;
        // A new position counts from now on, not since the last tick.
        if state.playing && !state.sought {
            let step_ns = passed.as_secs_f64() * f64::from(state.speed) * 1e9;
            state.position_ns = state.position_ns.saturating_add(step_ns as u64).min(end_ns);
            ended = state.position_ns == end_ns;
            state.playing = !ended;
        }
        let now = *state;
        state.sought = false;
        (now, ended)
    }
}

impl Drop for Playback {
    fn drop(&mut self) {
        if let Some(server) = self.server.take() {
            drop(server.stop());
        }
    }
}

/// The messages that are still to be sent.
struct Playing<'a> {
    messages: Messages<'a>,
    next: Option<(Topic, Entry)>,
}

impl Playing<'_> {
    /// Reads the next message of a topic that is shown, unless one is waiting.
    fn peek(&mut self) -> Option<&(Topic, Entry)> {
        while self.next.is_none() {
            let entry = self.messages.next()?;
            let topic = match &entry.message {
                Recorded::Known(payload) => Some(payload.topic()),
                Recorded::Unreadable(_) | Recorded::Other => None,
            };
            self.next = topic.filter(|topic| is_shown(*topic)).map(|topic| (topic, entry));
        }
        self.next.as_ref()
    }

    fn skip_before(&mut self, time_ns: u64) {
        while self.peek().is_some_and(|(_, entry)| entry.log_time_ns < time_ns) {
            self.next = None;
        }
    }

    fn send_until(&mut self, time_ns: u64, channels: &Channels) {
        while self.peek().is_some_and(|(_, entry)| entry.log_time_ns <= time_ns) {
            if let Some((topic, entry)) = self.next.take() {
                channels.send(topic, entry.log_time_ns, &entry.cdr);
            }
        }
    }
}
