//! Shows a node or a recording to Foxglove over WebSocket, by Foxglove's own SDK. Topics have the names, schemas and
//! encoding that they have in recordings.
//!
//! A client that is too slow loses the oldest messages that wait for it; the node never waits.

mod live;
mod playback;

use std::net::SocketAddr;
use std::sync::Arc;

use foxglove::{Context, FoxgloveError, PartialMetadata, RawChannel, Schema, WebSocketServer};

pub use live::LiveView;
pub use playback::{Playback, PlaybackError};

use crate::msgs::schema::{MESSAGE_ENCODING, SCHEMA_ENCODING, Topic};

/// Messages that may wait for a client.
const BACKLOG: usize = 4096;

/// Why a server for Foxglove cannot start.
#[derive(Debug, thiserror::Error)]
#[error("no server for Foxglove on {address}: {source}")]
pub struct ServerError {
    address: SocketAddr,
    source: FoxgloveError,
}

/// Whether a topic is shown. Blocks of samples are too large for it; their spectrogram is on the page.
fn is_shown(topic: Topic) -> bool {
    match topic {
        Topic::Waveform => false,
        Topic::OperatingPoint
        | Topic::Prediction
        | Topic::SessionEvent
        | Topic::RigInfo
        | Topic::Sensitivity
        | Topic::Diagnostics
        | Topic::Vibration
        | Topic::Heard
        | Topic::Temperature => true,
    }
}

/// The channels of one server.
struct Channels {
    context: Arc<Context>,
    channels: Vec<(Topic, Arc<RawChannel>)>,
}

impl Channels {
    fn open() -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let open = |topic: Topic| {
            let schema = Schema::new(topic.type_name(), SCHEMA_ENCODING, topic.schema().into_bytes());
            let builder = context.channel_builder(topic.name()).message_encoding(MESSAGE_ENCODING).schema(schema);
            Ok::<_, FoxgloveError>((topic, builder.build_raw()?))
        };
        let channels = Topic::ALL.into_iter().filter(|topic| is_shown(*topic)).map(open).collect::<Result<_, _>>()?;
        Ok(Self { context, channels })
    }

    /// A server for these channels, not started yet.
    fn server(&self, name: &str, address: SocketAddr) -> WebSocketServer {
        WebSocketServer::new()
            .context(&self.context)
            .name(name)
            .bind(address.ip().to_string(), address.port())
            .message_backlog_size(BACKLOG)
    }

    /// The channel of a topic, if it is shown and a client has subscribed to it.
    fn wanted(&self, topic: Topic) -> Option<&RawChannel> {
        let (_, channel) = self.channels.iter().find(|(known, _)| *known == topic)?;
        channel.has_sinks().then_some(channel)
    }

    /// Sends a message in CDR to the clients that have subscribed to its topic.
    fn send(&self, topic: Topic, time_ns: u64, cdr: &[u8]) {
        if let Some(channel) = self.wanted(topic) {
            channel.log_with_meta(cdr, PartialMetadata { log_time: Some(time_ns) });
        }
    }
}
