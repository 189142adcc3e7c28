//! Shared memory: fixed-size forms over iceoryx2. Each topic has an event service of the same name.
//!
//! A reader is a thread that sleeps until an event wakes it, takes all samples and passes them to a sink. A writer is a
//! pair of ports that any thread may use and that never blocks. A reader that is too slow loses the oldest samples,
//! which it detects as gaps in the sequence numbers.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Once};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::listener::{Listener, ListenerCreateError};
use iceoryx2::port::notifier::{Notifier, NotifierCreateError, NotifierNotifyError};
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::port::update_connections::{ConnectionFailure, UpdateConnections};
use iceoryx2::port::{LoanError, ReceiveError, SendError};
use iceoryx2::prelude::*;
use iceoryx2::service::builder::event::{EventCreateError, EventOpenError, EventOpenOrCreateError};
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError, PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::service::port_factory::{event, publish_subscribe};
use iceoryx2::waitset::{WaitSetAttachmentError, WaitSetCreateError};
use thiserror::Error;

use super::Bus;
use super::received::{Counters, Counts, Gaps, Received};
use super::shm_place;
use crate::msgs::shm::{
    Form, FormError, HeardForm, OperatingPointForm, PredictionForm, SensitivityForm, TemperatureForm, VibrationForm,
};

/// The ports may be used from any thread; peers with single-threaded ports can connect to them.
pub(super) type Ipc = ipc_threadsafe::Service;

/// Receives operating points: the node's input.
pub type ShmInput = ShmReader<OperatingPointForm>;
/// Publishes predictions: the node's output.
pub type ShmOutput = ShmWriter<PredictionForm>;
/// Publishes sensitivities.
pub type ShmSensitivity = ShmWriter<SensitivityForm>;
/// Receives sensitivities.
pub type ShmSensitivitySink = ShmReader<SensitivityForm>;
/// Publishes operating points: a rig or its simulator.
pub type ShmSource = ShmWriter<OperatingPointForm>;
/// Receives the measured vibration.
pub type ShmVibrationInput = ShmReader<VibrationForm>;
/// Publishes the measured vibration.
pub type ShmVibrationSource = ShmWriter<VibrationForm>;
/// Receives the temperature of the contact.
pub type ShmTemperatureInput = ShmReader<TemperatureForm>;
/// Publishes the temperature of the contact.
pub type ShmTemperatureSource = ShmWriter<TemperatureForm>;
/// Publishes squeals found in sound.
pub type ShmHeard = ShmWriter<HeardForm>;
/// Receives squeals found in sound.
pub type ShmHeardSink = ShmReader<HeardForm>;
/// Receives predictions.
pub type ShmSink = ShmReader<PredictionForm>;

pub(super) const MAX_PUBLISHERS: usize = 8;
const MAX_SUBSCRIBERS: usize = 32;
pub(super) const MAX_NODES: usize = 64;
const HISTORY_SAMPLES: usize = 16;

/// Interval at which a reader without events checks for samples and for the request to stop.
const TICK: Duration = Duration::from_millis(50);
/// Interval at which a reader removes the remains of killed processes.
const CLEANUP_PERIOD: Duration = Duration::from_secs(10);
/// Number of attempts to open a service that another process is creating or removing.
const OPEN_ATTEMPTS: usize = 50;
const OPEN_RETRY: Duration = Duration::from_millis(10);

/// Names of the services and their files.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ShmOptions {
    /// Prefix of all service names: `cell2/` gives `cell2/rig/operating_point`.
    pub service_prefix: String,
    /// Prefix of all file names instead of `iox2_`. Peers with another prefix are invisible. For tests.
    pub file_prefix: Option<String>,
}

/// Why shared memory failed.
#[derive(Debug, Error)]
pub enum ShmError {
    #[error("{0:?} is no service name of iceoryx2")]
    ServiceName(String),
    #[error("{0:?} is no file name prefix")]
    FilePrefix(String),
    #[error("iceoryx2 node in {}: {source:?}", path.display())]
    Node { path: PathBuf, source: NodeCreationFailure },
    #[error("iceoryx2's files: {}: {reason}", path.display())]
    Place { path: PathBuf, reason: String },
    #[error("{} has {free} bytes free, expected at least {limit}", path.display())]
    NoRoom { path: PathBuf, free: u64, limit: u64 },
    #[error("service {service}: {source:?}")]
    Topic { service: String, source: PublishSubscribeOpenOrCreateError },
    #[error("event service {service}: {source:?}")]
    Event { service: String, source: EventOpenOrCreateError },
    #[error("publisher of {service}: {source:?}")]
    Publisher { service: String, source: PublisherCreateError },
    #[error("notifier of {service}: {source:?}")]
    Notifier { service: String, source: NotifierCreateError },
    #[error("subscriber of {service}: {source:?}")]
    Subscriber { service: String, source: SubscriberCreateError },
    #[error("listener of {service}: {source:?}")]
    Listener { service: String, source: ListenerCreateError },
    #[error("wait set: {0:?}")]
    WaitSet(WaitSetCreateError),
    #[error("wait set: {0:?}")]
    Attach(WaitSetAttachmentError),
    #[error("reader thread: {0}")]
    Thread(#[from] std::io::Error),
    #[error("reader thread ended before it was ready")]
    ReaderGone,
    #[error(transparent)]
    Form(#[from] FormError),
    #[error("no memory for a sample of {service}: {source:?}")]
    Loan { service: String, source: LoanError },
    #[error("sample not sent on {service}: {source:?}")]
    Send { service: String, source: SendError },
    #[error("readers of {service} are not connected: {source:?}")]
    Readers { service: String, source: ConnectionFailure },
    #[error("sample sent on {service}, but its readers were not woken: {source:?}")]
    Notify { service: String, source: NotifierNotifyError },
}

/// Publishes messages over shared memory from any thread without blocking. If it is dropped right after its creation,
/// samples that its readers have not taken yet are lost, because readers only connect when they wake.
#[derive(Debug)]
pub struct ShmWriter<F: Form> {
    service: String,
    publisher: Publisher<Ipc, F, ()>,
    notifier: Notifier<Ipc>,
    topic: publish_subscribe::PortFactory<Ipc, F, ()>,
    // Declared last, because the ports must be dropped before their node.
    _node: Node<Ipc>,
}

impl<F: Form> ShmWriter<F> {
    /// Opens or creates the services and the ports.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn new(options: &ShmOptions) -> Result<Self, ShmError> {
        let node = new_node(options)?;
        let Services { service, topic, event } = Services::<F>::open(&node, options)?;
        let publisher = topic
            .publisher_builder()
            // The service may have been created without overflow by another process: a full reader must not block us
            // then either.
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .create()
            .map_err(|source| ShmError::Publisher { service: service.clone(), source })?;
        let notifier = new_notifier(&event, &service)?;
        Ok(Self { service, publisher, notifier, topic, _node: node })
    }

    /// Publishes a message and wakes the readers. Returns how many readers got it.
    ///
    /// # Errors
    /// A message that does not fit its form, or an error of iceoryx2. A later call may succeed.
    pub fn publish(&self, message: &F::Message) -> Result<usize, ShmError> {
        let form = F::from_message(message)?;
        let readers = self
            .publisher
            .send_copy(form)
            .map_err(|source| ShmError::Send { service: self.service.clone(), source })?;
        wake(&self.notifier, &self.service)?;
        Ok(readers)
    }
}

/// Wakes the readers of a service.
pub(super) fn wake(notifier: &Notifier<Ipc>, service: &str) -> Result<(), ShmError> {
    match notifier.notify() {
        // The creator of the service may have set a deadline; the readers were woken nevertheless.
        Ok(_) | Err(NotifierNotifyError::MissedDeadline | NotifierNotifyError::UnableToAcquireElapsedTime) => Ok(()),
        Err(source) => Err(ShmError::Notify { service: service.to_owned(), source }),
    }
}

impl<F: Form> ShmWriter<F> {
    /// Hands readers that came since the last message the latest ones, which they would otherwise get with the next.
    ///
    /// # Errors
    /// An error of iceoryx2.
    pub fn meet_readers(&self) -> Result<(), ShmError> {
        let connected = self.publisher.update_connections();
        connected.map_err(|source| ShmError::Readers { service: self.service.clone(), source })?;
        wake(&self.notifier, &self.service)
    }

    /// Number of readers, including killed ones whose remains have not been removed.
    pub fn readers(&self) -> usize {
        self.topic.dynamic_config().number_of_subscribers()
    }

    /// The name of the service.
    pub fn service(&self) -> &str {
        &self.service
    }

    /// Number of other writers, including killed ones whose remains have not been removed.
    pub fn other_writers(&self) -> usize {
        self.topic.dynamic_config().number_of_publishers().saturating_sub(1)
    }
}

/// Receives messages over shared memory on its own thread, until it is stopped or dropped.
#[derive(Debug)]
pub struct ShmReader<F: Form> {
    thread: ReadingThread,
    _form: std::marker::PhantomData<fn() -> F>,
}

impl<F: Form> ShmReader<F> {
    /// Opens or creates the services and starts the thread, on which `sink` gets every message. The latest messages of
    /// publishers that already exist come first (16 each with our own settings).
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn spawn(
        options: &ShmOptions,
        mut sink: impl FnMut(Received<F::Message>) + Send + 'static,
    ) -> Result<Self, ShmError> {
        Self::spawn_with_backlog(options, move |received, _| sink(received))
    }

    /// As [`ShmReader::spawn`]; `sink` also receives whether more samples are waiting. A sink that takes long for a
    /// message should only do so when none is waiting, or the oldest samples are lost.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn spawn_with_backlog(
        options: &ShmOptions,
        mut sink: impl FnMut(Received<F::Message>, bool) + Send + 'static,
    ) -> Result<Self, ShmError> {
        let node = new_node(options)?;
        let Services { service, topic, event } = Services::<F>::open(&node, options)?;
        // The listener is created first, so that every later sample wakes the thread.
        let listener = new_listener(&event, &service)?;
        let subscriber = topic
            .subscriber_builder()
            .create()
            .map_err(|source| ShmError::Subscriber { service: service.clone(), source })?;
        let mut gaps = Gaps::new();
        let thread = ReadingThread::spawn(F::SERVICE, node, listener, move |counters| {
            drain(&subscriber, &mut gaps, &mut sink, counters)
        })?;
        Ok(Self { thread, _form: std::marker::PhantomData })
    }

    /// The counts so far.
    pub fn counts(&self) -> Counts {
        self.thread.counts()
    }

    /// Stops the thread and waits for it, at most 50 ms plus the time of the sink. Dropping does the same.
    pub fn stop(self) {}
}

/// Passes a sample to the sink, copied and released at once, because a reader may hold only a few. Returns whether there
/// was one.
fn drain<F: Form>(
    subscriber: &Subscriber<Ipc, F, ()>,
    gaps: &mut Gaps<u128>,
    sink: &mut impl FnMut(Received<F::Message>, bool),
    counters: &Counters,
) -> bool {
    let (publisher, form) = match subscriber.receive() {
        Ok(Some(sample)) => (sample.origin().value(), *sample.payload()),
        Ok(None) => return false,
        Err(ReceiveError::ExceedsMaxBorrows | ReceiveError::ConnectionFailure(_)) => {
            counters.failure();
            return false;
        }
    };
    let missed = gaps.note(publisher, form.seq());
    match form.to_message() {
        Ok(message) => {
            counters.received(missed);
            let more_waits = subscriber.has_samples().unwrap_or(true);
            sink(Received::now(Bus::Shm, message), more_waits);
        }
        Err(_) => counters.malformed(),
    }
    true
}

/// A thread that sleeps until an event wakes it and then takes all samples. It ends when this is dropped, at most 50 ms
/// plus the time of its sink later.
#[derive(Debug)]
pub(super) struct ReadingThread {
    stop: Arc<AtomicBool>,
    counters: Arc<Counters>,
    thread: Option<JoinHandle<()>>,
}

impl ReadingThread {
    /// Starts the thread, which calls `take` for a sample until it returns that there is none.
    pub(super) fn spawn(
        service: &'static str,
        node: Node<Ipc>,
        listener: Listener<Ipc>,
        take: impl FnMut(&Counters) -> bool + Send + 'static,
    ) -> Result<Self, ShmError> {
        let stop = Arc::new(AtomicBool::new(false));
        let counters = Arc::new(Counters::default());
        let (ready, is_ready) = crossbeam_channel::bounded(1);
        let reading = Reading { node, stop: Arc::clone(&stop), counters: Arc::clone(&counters), take };
        let thread = thread::Builder::new()
            .name(format!("shm {}", service.rsplit('/').next().unwrap_or(service)))
            .spawn(move || reading.run(&listener, &ready))?;
        is_ready.recv().unwrap_or(Err(ShmError::ReaderGone))?;
        Ok(Self { stop, counters, thread: Some(thread) })
    }

    /// The counts so far.
    pub(super) fn counts(&self) -> Counts {
        self.counters.counts()
    }
}

impl Drop for ReadingThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // A panic of the sink was reported on that thread.
            let _ = thread.join();
        }
    }
}

/// State of the reading thread.
struct Reading<T> {
    take: T,
    stop: Arc<AtomicBool>,
    counters: Arc<Counters>,
    // Declared last, because the port in `take` must be dropped before its node.
    node: Node<Ipc>,
}

impl<T: FnMut(&Counters) -> bool> Reading<T> {
    fn run(mut self, listener: &Listener<Ipc>, ready: &crossbeam_channel::Sender<Result<(), ShmError>>) {
        let wait_set = match WaitSetBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create::<Ipc>() {
            Ok(wait_set) => wait_set,
            Err(error) => {
                let _ = ready.send(Err(ShmError::WaitSet(error)));
                return;
            }
        };
        let _attached = match wait_set.attach_notification(listener) {
            Ok(attached) => attached,
            Err(error) => {
                let _ = ready.send(Err(ShmError::Attach(error)));
                return;
            }
        };
        let _ = ready.send(Ok(()));

        let mut cleaned = Instant::now();
        self.drain();
        while !self.stop.load(Ordering::Acquire) {
            let counters = Arc::clone(&self.counters);
            let waited = wait_set.wait_and_process_once_with_timeout(
                |_| {
                    if listener.try_wait(|_| ()).is_err() {
                        counters.failure();
                    }
                    CallbackProgression::Continue
                },
                TICK,
            );
            if waited.is_err() {
                self.counters.failure();
                thread::sleep(TICK);
            }
            self.drain();
            if cleaned.elapsed() >= CLEANUP_PERIOD {
                self.node.try_cleanup_dead_nodes();
                cleaned = Instant::now();
            }
        }
    }

    /// Takes all available samples.
    fn drain(&mut self) {
        while !self.stop.load(Ordering::Acquire) && (self.take)(&self.counters) {}
    }
}

/// A notifier of the listeners of a service.
pub(super) fn new_notifier(event: &event::PortFactory<Ipc>, service: &str) -> Result<Notifier<Ipc>, ShmError> {
    let created = event.notifier_builder().create();
    created.map_err(|source| ShmError::Notifier { service: service.to_owned(), source })
}

/// A listener for the events of a service.
pub(super) fn new_listener(event: &event::PortFactory<Ipc>, service: &str) -> Result<Listener<Ipc>, ShmError> {
    let created = event.listener_builder().create();
    created.map_err(|source| ShmError::Listener { service: service.to_owned(), source })
}

/// A topic and its event service.
struct Services<F: Form> {
    service: String,
    topic: publish_subscribe::PortFactory<Ipc, F, ()>,
    event: event::PortFactory<Ipc>,
}

impl<F: Form> Services<F> {
    fn open(node: &Node<Ipc>, options: &ShmOptions) -> Result<Self, ShmError> {
        let service = format!("{}{}", options.service_prefix, F::SERVICE);
        let name = ServiceName::new(&service).map_err(|_| ShmError::ServiceName(service.clone()))?;
        let topic = retry(|| open_topic(node, &name), topic_in_flux)
            .map_err(|source| ShmError::Topic { service: service.clone(), source })?;
        let event = retry(|| open_event(node, &name), event_in_flux)
            .map_err(|source| ShmError::Event { service: service.clone(), source })?;
        Ok(Self { service, topic, event })
    }
}

pub(super) fn new_node(options: &ShmOptions) -> Result<Node<Ipc>, ShmError> {
    // iceoryx2 would log to the terminal, which may show a table. All errors are returned to the caller.
    static QUIET: Once = Once::new();
    QUIET.call_once(|| set_log_level_from_env_or(LogLevel::Fatal));

    let config = shm_place::config(options.file_prefix.as_deref())?;
    let path = shm_place::path_of(config.global.root_path());
    let node = NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(|source| ShmError::Node { path, source })?;
    node.try_cleanup_dead_nodes();
    Ok(node)
}

/// Opens the topic with the settings it has, or creates it with ours.
fn open_topic<F: Form>(
    node: &Node<Ipc>,
    name: &ServiceName,
) -> Result<publish_subscribe::PortFactory<Ipc, F, ()>, PublishSubscribeOpenOrCreateError> {
    type Error = PublishSubscribeOpenOrCreateError;
    match node.service_builder(name).publish_subscribe::<F>().open() {
        Ok(topic) => Ok(topic),
        Err(PublishSubscribeOpenError::DoesNotExist) => node
            .service_builder(name)
            .publish_subscribe::<F>()
            .max_publishers(MAX_PUBLISHERS)
            .max_subscribers(MAX_SUBSCRIBERS)
            .max_nodes(MAX_NODES)
            .history_size(HISTORY_SAMPLES)
            .subscriber_max_buffer_size(F::WAITING_SAMPLES)
            .create()
            .map_err(Error::PublishSubscribeCreateError),
        Err(other) => Err(Error::PublishSubscribeOpenError(other)),
    }
}

/// Opens the event service with the settings it has, or creates it with ours.
pub(super) fn open_event(
    node: &Node<Ipc>,
    name: &ServiceName,
) -> Result<event::PortFactory<Ipc>, EventOpenOrCreateError> {
    match node.service_builder(name).event().open() {
        Ok(event) => Ok(event),
        Err(EventOpenError::DoesNotExist) => node
            .service_builder(name)
            .event()
            .max_notifiers(MAX_PUBLISHERS)
            .max_listeners(MAX_SUBSCRIBERS)
            .max_nodes(MAX_NODES)
            .create()
            .map_err(EventOpenOrCreateError::EventCreateError),
        Err(other) => Err(EventOpenOrCreateError::EventOpenError(other)),
    }
}

/// Whether another process is creating or removing the topic at this moment.
pub(super) fn topic_in_flux(error: &PublishSubscribeOpenOrCreateError) -> bool {
    use PublishSubscribeCreateError as Create;
    use PublishSubscribeOpenError as Open;
    use PublishSubscribeOpenOrCreateError as Error;
    match error {
        Error::PublishSubscribeOpenError(open) => matches!(
            open,
            Open::DoesNotExist
                | Open::IsMarkedForDestruction
                | Open::HangsInCreation
                | Open::ServiceInCorruptedState
                | Open::ExceedsMaxNumberOfNodes
        ),
        Error::PublishSubscribeCreateError(create) => {
            matches!(create, Create::AlreadyExists | Create::IsBeingCreatedByAnotherInstance | Create::HangsInCreation)
        }
        Error::SystemInFlux => true,
    }
}

/// Whether another process is creating or removing the event service at this moment.
pub(super) fn event_in_flux(error: &EventOpenOrCreateError) -> bool {
    use EventCreateError as Create;
    use EventOpenError as Open;
    use EventOpenOrCreateError as Error;
    match error {
        Error::EventOpenError(open) => matches!(
            open,
            Open::DoesNotExist
                | Open::IsMarkedForDestruction
                | Open::HangsInCreation
                | Open::ServiceInCorruptedState
                | Open::ExceedsMaxNumberOfNodes
        ),
        Error::EventCreateError(create) => {
            matches!(create, Create::AlreadyExists | Create::IsBeingCreatedByAnotherInstance)
        }
        Error::SystemInFlux => true,
    }
}

pub(super) fn retry<T, E>(mut attempt: impl FnMut() -> Result<T, E>, passes: impl Fn(&E) -> bool) -> Result<T, E> {
    for _ in 1..OPEN_ATTEMPTS {
        match attempt() {
            Err(error) if passes(&error) => thread::sleep(OPEN_RETRY),
            done => return done,
        }
    }
    attempt()
}
