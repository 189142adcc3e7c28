//! Hands a [`Source`] to browsers: HTTP/1.1, GET only, one stream of states.
//!
//! Runs on a thread of its own. All pages together get one encoding of a state, at most 30 times a second; a page that
//! reads too slowly misses states, one that does not read at all is dropped. No request changes anything.

use std::convert::Infallible;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::{Query, Request, State as Shared};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event as Sent, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot, watch};
use tokio::time::{Instant, MissedTickBehavior, Sleep, interval, sleep};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::WatchStream;

use super::assets;
use super::comparison::Comparison;
use super::events::Events;
use crate::rig::Rig;

/// Time between two states: not more than 30 a second.
const EVERY: Duration = Duration::from_millis(34);
/// A client that takes nothing for this long is dropped.
const PATIENCE: Duration = Duration::from_secs(10);
/// A connection over which nothing goes in either direction for this long is dropped.
const IDLE: Duration = Duration::from_secs(30);
/// Maps, shapes and histories that are prepared at a time; more wait. Two may wait for each other's map.
const BLOCKING_THREADS: usize = 4;
/// Connections at a time; more wait.
const MOST_CONNECTIONS: usize = 256;
/// Pages that listen at a time; more are refused.
const MOST_LISTENERS: usize = 64;

const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// What a page can ask for. Every text is JSON.
pub trait Source: Send + Sync + 'static {
    fn about(&self) -> About;
    /// Called 30 times a second; the state to send, where there is a new one and anybody listens.
    fn tick(&self, listened_to: bool) -> Option<String>;
    fn state(&self, at_s: Option<f64>) -> String;
    fn history(&self) -> String;
    fn events(&self) -> Events;
    /// The measured vibration against the predictions; `None` where there is none, or a session still goes on.
    fn comparison(&self) -> Option<Comparison> {
        None
    }
    /// The curves of a stability map.
    fn map(&self, number: u64) -> Option<Arc<str>>;
    /// The shape of a mode.
    ///
    /// # Errors
    /// Why there is none.
    fn shape(&self, id: u32, at_s: Option<f64>) -> Result<String, String>;
}

/// What does not change.
#[derive(Clone, Debug, Serialize)]
pub struct About {
    /// `live` or `recording`.
    pub kind: &'static str,
    pub rig: String,
    pub content_hash: String,
    pub version: &'static str,
    pub band_max_hz: Option<f64>,
    pub mu_max: f64,
    pub warn_margin: f64,
    pub instability_threshold: f64,
    /// From which level on a measured vibration counts as squeal.
    pub vibration_threshold_db: f64,
    /// First and last moment of a recording, s since the epoch.
    pub span_s: Option<(f64, f64)>,
    /// When maps and charts of a recording became ready.
    pub notes: Vec<Note>,
}

/// Something that happened in a recording.
#[derive(Clone, Debug, Serialize)]
pub struct Note {
    pub onset_s: f64,
    pub what: &'static str,
    /// Of a map.
    pub normal_load_n: Option<f64>,
    pub disc_speed_rad_s: Option<f64>,
}

impl About {
    pub fn new(rig: &Rig, kind: &'static str, vibration_threshold_db: f64) -> Self {
        Self {
            kind,
            rig: rig.name.clone(),
            content_hash: rig.content_hash.clone(),
            version: env!("CARGO_PKG_VERSION"),
            band_max_hz: rig.band_max_hz,
            mu_max: rig.mu_max,
            warn_margin: rig.warning.margin,
            instability_threshold: rig.instability_threshold,
            vibration_threshold_db,
            span_s: None,
            notes: vec![],
        }
    }
}

/// A running server; it ends when this is dropped.
pub struct Server {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Server {
    /// Serves `source` on the first of `addresses` that is free.
    ///
    /// # Errors
    /// None of them is, or the system gives no runtime.
    pub fn start(addresses: &[SocketAddr], source: Arc<dyn Source>) -> io::Result<Self> {
        // Few threads for what takes longer: the allocator keeps memory for each.
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_io().enable_time().max_blocking_threads(BLOCKING_THREADS).build()?;
        let listener = runtime.block_on(TcpListener::bind(addresses))?;
        let address = listener.local_addr()?;
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new().name("display".to_owned()).spawn(move || {
            // Where there are too few processors, the node comes first. Threads made from here on inherit it; a system
            // that refuses changes nothing else.
            let _ = rustix::process::nice(5);
            runtime.block_on(async {
                tokio::select! { () = serve(listener, address, source) => {}, _ = stopped => {} }
            });
            runtime.shutdown_background();
        })?;
        Ok(Self { address, stop: Some(stop), thread: Some(thread) })
    }

    /// Where it serves.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[derive(Clone)]
struct App {
    source: Arc<dyn Source>,
    states: watch::Sender<Arc<str>>,
    listeners: Arc<AtomicUsize>,
    address: SocketAddr,
}

async fn serve(listener: TcpListener, address: SocketAddr, source: Arc<dyn Source>) {
    let app = App { source, states: watch::Sender::new("".into()), listeners: Arc::default(), address };
    let router = Router::new()
        .route("/stream", get(stream))
        .route("/about.json", get(about))
        .route("/state.json", get(state))
        .route("/history.json", get(history))
        .route("/events.json", get(events_json))
        .route("/events.csv", get(events_csv))
        .route("/comparison.json", get(comparison))
        .route("/map.json", get(map))
        .route("/shape.json", get(shape))
        .fallback(get(asset))
        .layer(from_fn_with_state(app.clone(), guard))
        .with_state(app.clone());
    let listener = Patient { listener, permits: Arc::new(Semaphore::new(MOST_CONNECTIONS)) };
    tokio::select! {
        _ = axum::serve(listener, router) => {}
        () = send_states(app) => {}
    }
}

async fn send_states(app: App) {
    let mut ticks = interval(EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let listened_to = app.listeners.load(Ordering::Relaxed) > 0;
        if let Some(state) = app.source.tick(listened_to) {
            app.states.send_replace(state.into());
        }
    }
}

/// Refuses names this server is not known by, so that no other site can reach it through a name of its own; and
/// tells the browser to load nothing from elsewhere.
async fn guard(Shared(app): Shared<App>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or("");
    let mut response = if is_own_name(host, app.address.ip()) {
        next.run(request).await
    } else {
        (StatusCode::FORBIDDEN, "this display is reached by the address it serves on").into_response()
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (header::CACHE_CONTROL, "no-cache"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Whether a Host header names an address rather than a name of somebody else's; on loopback, a loopback address.
fn is_own_name(host: &str, bound: IpAddr) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or(""),
        None => host.split(':').next().unwrap_or(""),
    };
    match name.parse::<IpAddr>() {
        Ok(address) => !bound.is_loopback() || address.is_loopback(),
        Err(_) => name.eq_ignore_ascii_case("localhost"),
    }
}

/// Counts a page for as long as it listens.
struct Listening(Arc<AtomicUsize>);

impl Drop for Listening {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

async fn stream(Shared(app): Shared<App>) -> Response {
    let listening = Listening(app.listeners.clone());
    if app.listeners.fetch_add(1, Ordering::Relaxed) >= MOST_LISTENERS {
        return (StatusCode::SERVICE_UNAVAILABLE, format!("{MOST_LISTENERS} pages listen already")).into_response();
    }
    let states = WatchStream::from_changes(app.states.subscribe()).map(move |state| {
        let _counted = &listening;
        Ok::<_, Infallible>(Sent::default().data(&*state))
    });
    Sse::new(states).into_response()
}

#[derive(Deserialize)]
struct Moment {
    at: Option<f64>,
}

#[derive(Deserialize)]
struct MapAsked {
    number: u64,
}

#[derive(Deserialize)]
struct ShapeAsked {
    id: u32,
    at: Option<f64>,
}

async fn about(Shared(app): Shared<App>) -> Response {
    json(serde_json::to_string(&app.source.about()).unwrap_or_default())
}

async fn state(Shared(app): Shared<App>, Query(moment): Query<Moment>) -> Response {
    aside(move || json(app.source.state(moment.at))).await
}

async fn history(Shared(app): Shared<App>) -> Response {
    aside(move || json(app.source.history())).await
}

async fn comparison(Shared(app): Shared<App>) -> Response {
    aside(move || json(serde_json::to_string(&app.source.comparison()).unwrap_or_default())).await
}

async fn events_json(Shared(app): Shared<App>) -> Response {
    aside(move || {
        let events = app.source.events();
        let shown: Vec<_> = events.iter().collect();
        json(serde_json::to_string(&shown).unwrap_or_default())
    })
    .await
}

async fn events_csv(Shared(app): Shared<App>) -> Response {
    aside(move || {
        let headers = [
            (header::CONTENT_TYPE, "text/csv; charset=utf-8"),
            (header::CONTENT_DISPOSITION, "attachment; filename=\"squealcast-events.csv\""),
        ];
        (headers, app.source.events().to_csv()).into_response()
    })
    .await
}

async fn map(Shared(app): Shared<App>, Query(asked): Query<MapAsked>) -> Response {
    aside(move || match app.source.map(asked.number) {
        Some(curves) => json(curves.to_string()),
        None => (StatusCode::NOT_FOUND, "no such stability map").into_response(),
    })
    .await
}

async fn shape(Shared(app): Shared<App>, Query(asked): Query<ShapeAsked>) -> Response {
    aside(move || match app.source.shape(asked.id, asked.at) {
        Ok(shape) => json(shape),
        Err(reason) => (StatusCode::NOT_FOUND, reason).into_response(),
    })
    .await
}

async fn asset(headers: HeaderMap, request: Request) -> Response {
    let Some(asset) = assets::find(request.uri().path().trim_start_matches('/')) else {
        return (StatusCode::NOT_FOUND, "no such page").into_response();
    };
    let accepted = headers.get(header::ACCEPT_ENCODING).and_then(|value| value.to_str().ok()).unwrap_or("");
    let media_type = (header::CONTENT_TYPE, asset.media_type);
    if accepted.split(',').any(|encoding| encoding.split(';').next().is_some_and(|name| name.trim() == "zstd")) {
        ([media_type, (header::CONTENT_ENCODING, "zstd")], asset.compressed()).into_response()
    } else {
        ([media_type], asset.bytes).into_response()
    }
}

fn json(text: String) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], Body::from(text)).into_response()
}

/// Work that may take a while, beside the thread that sends states.
async fn aside(work: impl FnOnce() -> Response + Send + 'static) -> Response {
    match tokio::task::spawn_blocking(work).await {
        Ok(response) => response,
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Accepts a bounded number of connections, each of which fails when its other end takes nothing for too long, or when
/// nothing at all happens on it.
struct Patient {
    listener: TcpListener,
    permits: Arc<Semaphore>,
}

struct PatientStream {
    stream: TcpStream,
    waiting: Option<Pin<Box<Sleep>>>,
    idle: Pin<Box<Sleep>>,
    _permit: Option<OwnedSemaphorePermit>,
}

impl axum::serve::Listener for Patient {
    type Io = PatientStream;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (PatientStream, SocketAddr) {
        // The semaphore is never closed: there is always a permit in the end.
        let permit = self.permits.clone().acquire_owned().await.ok();
        loop {
            match self.listener.accept().await {
                Ok((stream, address)) => {
                    let _ = stream.set_nodelay(true);
                    let idle = Box::pin(sleep(IDLE));
                    return (PatientStream { stream, waiting: None, idle, _permit: permit }, address);
                }
                // Out of file descriptors, or the client has gone again.
                Err(_) => sleep(Duration::from_millis(50)).await,
            }
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

impl PatientStream {
    fn judge<T>(&mut self, written: Poll<io::Result<T>>, context: &mut Context<'_>) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.waiting = None;
            self.idle.as_mut().reset(Instant::now() + IDLE);
            return written;
        }
        let waiting = self.waiting.get_or_insert_with(|| Box::pin(sleep(PATIENCE)));
        match waiting.as_mut().poll(context) {
            Poll::Ready(()) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl AsyncRead for PatientStream {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(cx, buffer);
        if read.is_ready() {
            self.idle.as_mut().reset(Instant::now() + IDLE);
            return read;
        }
        match self.idle.as_mut().poll(cx) {
            Poll::Ready(()) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl AsyncWrite for PatientStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.judge(written, cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, parts);
        self.judge(written, cx)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_its_own_addresses_are_names_of_a_display() {
        let (loopback, anywhere): (IpAddr, IpAddr) = ([127, 0, 0, 1].into(), [0, 0, 0, 0].into());
        for host in ["127.0.0.1:8765", "localhost:8765", "LOCALHOST", "[::1]:8765"] {
            assert!(is_own_name(host, loopback), "{host}");
        }
        for host in ["", "evil.example:8765", "127.0.0.1.evil.example", "192.168.1.5:8765"] {
            assert!(!is_own_name(host, loopback), "{host}");
        }
        assert!(is_own_name("192.168.1.5:8765", anywhere));
        assert!(!is_own_name("evil.example", anywhere));
    }
}
