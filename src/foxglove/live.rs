//! A running node, as Foxglove shows it: its topics and its parameters.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use foxglove::WebSocketServerHandle;
use foxglove::websocket::{
    AnyClient, ChannelView, Client, GetParametersResponder, Parameter, ParameterHandler, ParameterValue,
    ServerListener, SetParametersResponder,
};

use super::{Channels, ServerError};
use crate::bus::Sink;
use crate::msgs::schema::Topic;
use crate::msgs::{SessionEvent, SessionEventKind};
use crate::recording::message::Payload;
use crate::session::settings::{self, Settings};
use crate::system::clock::Reading;

/// Shows a node until it is dropped.
pub struct LiveView {
    channels: Channels,
    parameters: Arc<Parameters>,
    rig: Arc<Latched>,
    server: Option<WebSocketServerHandle>,
}

impl LiveView {
    /// Starts the server. Parameters that a client sets are validated and handed to `sink`, as from any other bus.
    ///
    /// # Errors
    /// The address is taken.
    pub fn start(
        address: SocketAddr,
        name: &str,
        settings: Settings,
        sink: Arc<dyn Sink>,
    ) -> Result<Self, ServerError> {
        let failed = |source| ServerError { address, source };
        let channels = Channels::open().map_err(failed)?;
        let parameters = Arc::new(Parameters { settings: Mutex::new(settings), sink });
        let rig = Arc::<Latched>::default();
        let server = channels
            .server(name, address)
            .parameter_handler(parameters.clone())
            .listener(rig.clone())
            .start_blocking()
            .map_err(failed)?;
        Ok(Self { channels, parameters, rig, server: Some(server) })
    }

    /// The port it listens to.
    pub fn port(&self) -> u16 {
        self.server.as_ref().map_or(0, WebSocketServerHandle::port)
    }

    /// Whether a client has subscribed to a topic.
    pub fn is_wanted(&self, topic: Topic) -> bool {
        self.channels.wanted(topic).is_some()
    }

    /// Shows a message that was received or made at `at`.
    pub fn show(&self, at: Reading, payload: &Payload) {
        let (topic, time_ns) = (payload.topic(), u64::try_from(at.wall_ns).unwrap_or_default());
        if let Payload::SessionEvent(event) = payload {
            self.applied(event);
        }
        if topic != Topic::RigInfo {
            self.send_rig(time_ns);
        } else if let Ok(cdr) = payload.to_cdr() {
            *self.rig.message.lock().unwrap_or_else(PoisonError::into_inner) = cdr;
            self.rig.is_due.store(true, Ordering::Relaxed);
            return self.send_rig(time_ns);
        }
        // Content that CDR cannot represent is reported by the recorder.
        if self.is_wanted(topic)
            && let Ok(cdr) = payload.to_cdr()
        {
            self.channels.send(topic, time_ns, &cdr);
        }
    }

    /// Tells clients of a parameter that the session has taken.
    fn applied(&self, event: &SessionEvent) {
        if SessionEventKind::of(event) != Some(SessionEventKind::Parameter) {
            return;
        }
        // The session has validated it.
        if self.parameters.settings().set(&event.name, event.value).is_ok()
            && let Some(server) = &self.server
        {
            server.publish_parameter_values(vec![Parameter::float64(&event.name, event.value)]);
        }
    }

    /// Sends the description of the rig, once it is known, to everybody if somebody has subscribed to it since.
    fn send_rig(&self, time_ns: u64) {
        if self.is_wanted(Topic::RigInfo) && self.rig.is_due.swap(false, Ordering::Relaxed) {
            let cdr = self.rig.message.lock().unwrap_or_else(PoisonError::into_inner);
            if !cdr.is_empty() {
                self.channels.send(Topic::RigInfo, time_ns, &cdr);
            }
        }
    }
}

impl Drop for LiveView {
    fn drop(&mut self) {
        if let Some(server) = self.server.take() {
            drop(server.stop());
        }
    }
}

/// The description of the rig, which later clients get too.
#[derive(Default)]
struct Latched {
    message: Mutex<Vec<u8>>,
    is_due: AtomicBool,
}

impl ServerListener for Latched {
    fn on_subscribe(&self, _client: Client, channel: ChannelView<'_>) {
        // It is sent with the next message: at this moment the client is not subscribed yet.
        if channel.topic() == Topic::RigInfo.name() {
            self.is_due.store(true, Ordering::Relaxed);
        }
    }
}

/// The parameters of the node: the settings of its session.
struct Parameters {
    settings: Mutex<Settings>,
    sink: Arc<dyn Sink>,
}

impl Parameters {
    fn settings(&self) -> MutexGuard<'_, Settings> {
        self.settings.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The present values of the parameters `names`, of all without names.
    fn values(&self, names: &[String]) -> Vec<Parameter> {
        let settings = *self.settings();
        let wanted = |name: &str| names.is_empty() || names.iter().any(|known| known == name);
        settings
            .values()
            .filter(|(name, _)| wanted(name))
            .map(|(name, value)| Parameter::float64(name, value))
            .collect()
    }

    /// Hands a value to the node.
    fn set(&self, parameter: &Parameter) -> Result<(), String> {
        let value = match &parameter.value {
            Some(ParameterValue::Float64(value)) => *value,
            Some(ParameterValue::Integer(value)) => *value as f64,
            Some(
                ParameterValue::Bool(_)
                | ParameterValue::String(_)
                | ParameterValue::Array(_)
                | ParameterValue::Dict(_),
            )
            | None => return Err(format!("{} is a number", parameter.name)),
        };
        settings::validate(&parameter.name, value).map_err(|error| error.to_string())?;
        // Already here, so that the answer to the client has it.
        self.settings().set(&parameter.name, value).map_err(|error| error.to_string())?;
        self.sink.parameter(&parameter.name, value);
        Ok(())
    }
}

impl ParameterHandler for Parameters {
    fn get(
        &self,
        _client: AnyClient,
        names: Vec<String>,
        _request_id: Option<String>,
        responder: GetParametersResponder,
    ) {
        responder.respond(self.values(&names));
    }

    fn set(
        &self,
        client: AnyClient,
        parameters: Vec<Parameter>,
        _request_id: Option<String>,
        responder: SetParametersResponder,
    ) {
        for parameter in &parameters {
            if let Err(why) = Self::set(self, parameter) {
                client.send_error(why);
            }
        }
        let names: Vec<String> = parameters.into_iter().map(|parameter| parameter.name).collect();
        responder.respond(if names.is_empty() { vec![] } else { self.values(&names) });
    }
}
