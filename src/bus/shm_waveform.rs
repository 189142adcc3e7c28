//! Samples of microphones and accelerometers over shared memory: slices of f32 whose user header describes them.
//!
//! A writer hands over the memory that it wrote the samples to; a reader copies them from there.

use iceoryx2::port::ReceiveError;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError};
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::Bus;
use super::received::{Counters, Counts, Received};
use super::shm::{
    Ipc, MAX_NODES, MAX_PUBLISHERS, ReadingThread, ShmError, ShmOptions, event_in_flux, new_listener, new_node,
    new_notifier, open_event, retry, topic_in_flux, wake,
};
use crate::msgs::Waveform;
use crate::msgs::shm::WaveformHeader;

/// Readers of samples. Every writer reserves memory for what may wait for all of them.
const MAX_SUBSCRIBERS: usize = 4;
/// Samples per block for which a writer reserves memory at first; it reserves more when it sends a longer block.
const USUAL_SAMPLES: usize = 1024;

type Topic = publish_subscribe::PortFactory<Ipc, [f32], WaveformHeader>;

/// Publishes samples over shared memory without blocking: a microphone or its stand-in.
#[derive(Debug)]
pub struct ShmWaveformSource {
    service: String,
    publisher: Publisher<Ipc, [f32], WaveformHeader>,
    notifier: Notifier<Ipc>,
    topic: Topic,
    // Declared last, because the ports must be dropped before their node.
    _node: Node<Ipc>,
}

impl ShmWaveformSource {
    /// Opens or creates the services and the ports.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn new(options: &ShmOptions) -> Result<Self, ShmError> {
        let node = new_node(options)?;
        let (service, topic, event) = open(&node, options)?;
        let publisher = topic
            .publisher_builder()
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .initial_max_slice_len(USUAL_SAMPLES)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create()
            .map_err(|source| ShmError::Publisher { service: service.clone(), source })?;
        let notifier = new_notifier(&event, &service)?;
        Ok(Self { service, publisher, notifier, topic, _node: node })
    }

    /// Publishes a block of samples and wakes the readers. Returns how many readers got it.
    ///
    /// # Errors
    /// A message that does not fit its form, or an error of iceoryx2. A later call may succeed.
    pub fn publish(&self, message: &Waveform) -> Result<usize, ShmError> {
        let header = WaveformHeader::from_message(message)?;
        let mut block = self
            .publisher
            .loan_slice_uninit(message.samples.len())
            .map_err(|source| ShmError::Loan { service: self.service.clone(), source })?;
        *block.user_header_mut() = header;
        let sent = block.write_from_slice(&message.samples).send();
        let readers = sent.map_err(|source| ShmError::Send { service: self.service.clone(), source })?;
        wake(&self.notifier, &self.service)?;
        Ok(readers)
    }

    /// Number of readers, including killed ones whose remains have not been removed.
    pub fn readers(&self) -> usize {
        self.topic.dynamic_config().number_of_subscribers()
    }
}

/// Receives samples over shared memory on its own thread, until it is dropped.
#[derive(Debug)]
pub struct ShmWaveformInput {
    thread: ReadingThread,
}

impl ShmWaveformInput {
    /// Opens or creates the services and starts the thread, on which `sink` gets every block.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn spawn(
        options: &ShmOptions,
        mut sink: impl FnMut(Received<Waveform>) + Send + 'static,
    ) -> Result<Self, ShmError> {
        let node = new_node(options)?;
        let (service, topic, event) = open(&node, options)?;
        // The listener is created first, so that every later block wakes the thread.
        let listener = new_listener(&event, &service)?;
        let subscriber = topic
            .subscriber_builder()
            .create()
            .map_err(|source| ShmError::Subscriber { service: service.clone(), source })?;
        let thread = ReadingThread::spawn(WaveformHeader::SERVICE, node, listener, move |counters| {
            take(&subscriber, &mut sink, counters)
        })?;
        Ok(Self { thread })
    }

    /// The counts so far. Blocks have no sequence numbers: their stamps show what is missing.
    pub fn counts(&self) -> Counts {
        self.thread.counts()
    }
}

/// Passes a block to the sink; returns whether there was one.
fn take(
    subscriber: &Subscriber<Ipc, [f32], WaveformHeader>,
    sink: &mut impl FnMut(Received<Waveform>),
    counters: &Counters,
) -> bool {
    match subscriber.receive() {
        Ok(Some(block)) => match block.user_header().to_message(block.payload()) {
            Ok(message) => {
                drop(block);
                counters.received(0);
                sink(Received::now(Bus::Shm, message));
            }
            Err(_) => counters.malformed(),
        },
        Ok(None) => return false,
        Err(ReceiveError::ExceedsMaxBorrows | ReceiveError::ConnectionFailure(_)) => {
            counters.failure();
            return false;
        }
    }
    true
}

/// The service of samples and its event service, with their name.
fn open(node: &Node<Ipc>, options: &ShmOptions) -> Result<(String, Topic, event::PortFactory<Ipc>), ShmError> {
    let service = format!("{}{}", options.service_prefix, WaveformHeader::SERVICE);
    let name = ServiceName::new(&service).map_err(|_| ShmError::ServiceName(service.clone()))?;
    let topic = retry(|| open_topic(node, &name), topic_in_flux)
        .map_err(|source| ShmError::Topic { service: service.clone(), source })?;
    let event = retry(|| open_event(node, &name), event_in_flux)
        .map_err(|source| ShmError::Event { service: service.clone(), source })?;
    Ok((service, topic, event))
}

/// Opens the service with the settings it has, or creates it with ours. Without a history: old samples would look like a
/// stream of their own.
fn open_topic(node: &Node<Ipc>, name: &ServiceName) -> Result<Topic, PublishSubscribeOpenOrCreateError> {
    type Error = PublishSubscribeOpenOrCreateError;
    let builder = || node.service_builder(name).publish_subscribe::<[f32]>().user_header::<WaveformHeader>();
    match builder().open() {
        Ok(topic) => Ok(topic),
        Err(PublishSubscribeOpenError::DoesNotExist) => builder()
            .max_publishers(MAX_PUBLISHERS)
            .max_subscribers(MAX_SUBSCRIBERS)
            .max_nodes(MAX_NODES)
            .history_size(0)
            .subscriber_max_buffer_size(WaveformHeader::WAITING_BLOCKS)
            .create()
            .map_err(Error::PublishSubscribeCreateError),
        Err(other) => Err(Error::PublishSubscribeOpenError(other)),
    }
}
