//! Serves [`Pages`] to browsers: HTTP/1.1, GET only, with one stream of states.
//!
//! Runs on its own thread. A state is encoded once for all pages, at most 30 times a second. A page that reads too
//! slowly misses states. `connections` limits what clients can use. No request changes anything.

use std::convert::Infallible;
use std::io;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::{Extension, Query, RawPathParams, Request, State as Shared};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event as Sent, Sse};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use serde::{Deserialize, Serialize};
use tokio::net::TcpListener;
use tokio::sync::{oneshot, watch};
use tokio::time::{MissedTickBehavior, interval};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::WatchStream;

use super::assets;
use super::comparison::Comparison;
use super::connections::{self, Bounds};
use super::events::{Events, PageColumn, page_columns};
use super::heard::SquealsInSound;
use super::metrics;
use super::shelf::Shelf;
use super::sound_page::{SoundShown, SpectrogramPicture};
use crate::node::status::InputSources;
use crate::rig::Rig;
use crate::sound::spectrogram::Part;

/// Time between two states: at most 30 per second.
const EVERY: Duration = Duration::from_millis(34);
/// Number of maps, shapes and histories prepared at the same time; further requests wait. Two may wait for each other's
/// map.
const BLOCKING_THREADS: usize = 4;

const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Provides the data of a page. Every text is JSON.
pub trait Source: Send + Sync + 'static {
    fn about(&self) -> About;
    /// Called 30 times a second. Returns the state to send if there is a new one and a page is connected.
    fn tick(&self, listened_to: bool) -> Option<String>;
    fn state(&self, at_s: Option<f64>) -> String;
    fn history(&self) -> String;
    fn events(&self) -> Events;
    /// The squeals found in samples.
    fn squeals_in_sound(&self) -> SquealsInSound;
    /// Channels of sound, and the scores of the predictions against it.
    fn sound(&self) -> SoundShown;
    /// The spectrogram of a channel, whole or a part of it in detail; `None` if there is none.
    fn spectrogram(&self, channel: &str, part: Option<Part>) -> Option<SpectrogramPicture>;
    /// The measured vibration compared with the predictions; `None` without measurements, or while a session is
    /// running.
    fn comparison(&self) -> Option<Comparison> {
        None
    }
    /// State and counters as Prometheus text; `None` for a recording.
    fn metrics(&self) -> Option<String> {
        None
    }
    /// The curves of a stability map.
    fn map(&self, number: u64) -> Option<Arc<str>>;
    /// The shape of a mode.
    ///
    /// # Errors
    /// Why it cannot be computed.
    fn shape(&self, id: u32, at_s: Option<f64>) -> Result<String, String>;
    /// The force of every contact pair, for a rig with a contact state.
    ///
    /// # Errors
    /// Why it is not known.
    fn contact(&self, at_s: Option<f64>) -> Result<String, String>;
}

/// What a server shows.
pub enum Pages {
    One(Arc<dyn Source>),
    /// Several recordings, each below its number, from 1.
    Recordings(Shelf),
}

/// Constant properties of a source.
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
    /// Level from which on a measured vibration counts as squeal, dB.
    pub vibration_threshold_db: f64,
    /// Whether contact pairs of the rig open and close, so that their forces are shown.
    pub contact_state: bool,
    /// Whether the inputs are from the rig simulator.
    pub simulated: bool,
    /// Where a node expects its inputs.
    pub inputs: Option<InputSources>,
    /// First and last moment of a recording, s since the epoch.
    pub span_s: Option<(f64, f64)>,
    /// When maps and charts of a recording became available.
    pub notes: Vec<Note>,
    /// The columns of the table of events.
    pub event_columns: Vec<PageColumn>,
}

/// Something that happened in a recording.
#[derive(Clone, Debug, Serialize)]
pub struct Note {
    pub onset_s: f64,
    pub what: &'static str,
    /// Load and speed of a map.
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
            contact_state: rig.model.statics().is_some(),
            simulated: false,
            inputs: None,
            span_s: None,
            notes: vec![],
            event_columns: page_columns(),
        }
    }
}

/// A running server; it stops when it is dropped.
pub struct Server {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Server {
    /// Serves `pages` on the first free address of `addresses`.
    ///
    /// # Errors
    /// No address is free, or the system cannot provide a runtime.
    pub fn start(addresses: &[SocketAddr], pages: Pages) -> io::Result<Self> {
        // Few threads for blocking work, since the allocator keeps memory for each.
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_io().enable_time().max_blocking_threads(BLOCKING_THREADS).build()?;
        let listener = runtime.block_on(async { connections::listen(addresses) })?;
        let address = listener.local_addr()?;
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new().name("display".to_owned()).spawn(move || {
            // On a machine with few processors the node has precedence. Threads created from here on inherit the
            // niceness; a refusal of the system has no other effect.
            let _ = rustix::process::nice(5);
            runtime.block_on(async {
                tokio::select! { () = serve(listener, address, pages) => {}, _ = stopped => {} }
            });
            runtime.shutdown_background();
        })?;
        Ok(Self { address, stop: Some(stop), thread: Some(thread) })
    }

    /// The address on which it serves.
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
    pages: Arc<Pages>,
    states: watch::Sender<Arc<str>>,
    listeners: Arc<AtomicUsize>,
    address: SocketAddr,
}

async fn serve(listener: TcpListener, address: SocketAddr, pages: Pages) {
    let app = App { pages: Arc::new(pages), states: watch::Sender::new("".into()), listeners: Arc::default(), address };
    let page = Router::new()
        .route("/stream", get(stream))
        .route("/about.json", get(about))
        .route("/state.json", get(state))
        .route("/history.json", get(history))
        .route("/events.json", get(events_json))
        .route("/events.csv", get(events_csv))
        .route("/squeals-in-sound.json", get(squeals_in_sound))
        .route("/comparison.json", get(comparison))
        .route("/sound.json", get(sound))
        .route("/spectrogram.png", get(spectrogram))
        .route("/map.json", get(map))
        .route("/shape.json", get(shape))
        .route("/contact.json", get(contact))
        .route("/metrics", get(metrics_text))
        .route_layer(from_fn_with_state(app.clone(), choose))
        // Neither needs a recording to be open.
        .route("/recordings.json", get(recordings))
        .route("/", get(asset))
        .route("/{file}", get(asset))
        .route("/vendor/{file}", get(asset));
    let router = match &*app.pages {
        Pages::One(_) => page,
        Pages::Recordings(shelf) => {
            // The last by name, which of sessions is the latest.
            let last = format!("/{}/", shelf.names().len());
            Router::new().route("/", get(async move || Redirect::temporary(&last))).nest("/{number}/", page)
        }
    };
    let router = router.layer(from_fn_with_state(app.clone(), guard)).with_state(app.clone());
    tokio::select! {
        () = connections::serve(listener, router, Bounds::default()) => {}
        () = send_states(app) => {}
    }
}

/// The number of the recording in the path of a request.
fn number(path: &RawPathParams) -> Option<usize> {
    path.iter().find(|(name, _)| *name == "number")?.1.parse().ok()
}

/// Hands the source that a request is about to its handler.
async fn choose(Shared(app): Shared<App>, path: RawPathParams, mut request: Request, next: Next) -> Response {
    let source = match &*app.pages {
        Pages::One(source) => Ok(source.clone()),
        Pages::Recordings(_) => {
            let (pages, number) = (app.pages.clone(), number(&path));
            let opened = tokio::task::spawn_blocking(move || match &*pages {
                Pages::One(source) => Ok(source.clone()),
                Pages::Recordings(shelf) => shelf.source(number),
            });
            opened.await.unwrap_or_else(|_| Err("the recording cannot be read".to_owned()))
        }
    };
    match source {
        Ok(source) => {
            request.extensions_mut().insert(source);
            next.run(request).await
        }
        Err(reason) => (StatusCode::NOT_FOUND, reason).into_response(),
    }
}

/// The names of the recordings, and the number of the one of this page; none if the server has only one page.
async fn recordings(Shared(app): Shared<App>, path: RawPathParams) -> Response {
    let names = match &*app.pages {
        Pages::One(_) => &[][..],
        Pages::Recordings(shelf) => shelf.names(),
    };
    json(serde_json::json!({ "names": names, "number": number(&path) }).to_string())
}

async fn send_states(app: App) {
    let Pages::One(source) = &*app.pages else {
        // Recordings have nothing to send.
        return std::future::pending().await;
    };
    let mut ticks = interval(EVERY);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let listened_to = app.listeners.load(Ordering::Relaxed) > 0;
        if let Some(state) = source.tick(listened_to) {
            app.states.send_replace(state.into());
        }
    }
}

/// Refuses requests for host names other than the server's, so that no other site can reach it through a name of that
/// site. Tells the browser to load nothing from other origins.
async fn guard(Shared(app): Shared<App>, request: Request, next: Next) -> Response {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or("");
    let mut response = if is_own_name(host, app.address.ip()) {
        next.run(request).await
    } else {
        (StatusCode::FORBIDDEN, "this display is only available at the address it serves on").into_response()
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

/// Whether a Host header contains an address instead of a foreign name; on loopback, a loopback address.
fn is_own_name(host: &str, bound: IpAddr) -> bool {
    let bracketed = || host.strip_prefix('[')?.strip_suffix(']')?.parse::<Ipv6Addr>().ok().map(IpAddr::from);
    let with_port = host.parse::<SocketAddr>().ok().map(|address| address.ip());
    match with_port.or_else(|| host.parse().ok()).or_else(bracketed) {
        Some(address) => !bound.is_loopback() || address.is_loopback(),
        None => {
            let (name, port) = host.split_once(':').unwrap_or((host, "0"));
            name.eq_ignore_ascii_case("localhost") && port.parse::<u16>().is_ok()
        }
    }
}

/// Whether an `Accept-Encoding` header accepts zstd: listed, with a weight other than 0.
fn takes_zstd(accepted: &str) -> bool {
    accepted.split(',').any(|encoding| {
        let mut parts = encoding.split(';').map(str::trim);
        let named = parts.next().is_some_and(|name| name.eq_ignore_ascii_case("zstd"));
        let weight = parts.find_map(|part| part.strip_prefix("q=").or(part.strip_prefix("Q=")));
        named && weight.is_none_or(|weight| weight.trim().parse::<f64>().is_ok_and(|weight| weight > 0.0))
    })
}

/// Counts a page as long as it is connected.
struct Listening(Arc<AtomicUsize>);

impl Drop for Listening {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

async fn stream(Shared(app): Shared<App>) -> Response {
    app.listeners.fetch_add(1, Ordering::Relaxed);
    let listening = Listening(app.listeners.clone());
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

async fn about(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    json(serde_json::to_string(&source.about()).unwrap_or_default())
}

async fn state(Extension(source): Extension<Arc<dyn Source>>, Query(moment): Query<Moment>) -> Response {
    aside(move || json(source.state(moment.at))).await
}

async fn history(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    aside(move || json(source.history())).await
}

async fn comparison(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    aside(move || json(serde_json::to_string(&source.comparison()).unwrap_or_default())).await
}

async fn events_json(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    aside(move || {
        let events = source.events();
        let shown: Vec<_> = events.iter().collect();
        json(serde_json::to_string(&shown).unwrap_or_default())
    })
    .await
}

async fn squeals_in_sound(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    aside(move || json(source.squeals_in_sound().to_json())).await
}

#[derive(Deserialize)]
struct SpectrogramAsked {
    channel: String,
    from_s: Option<f64>,
    to_s: Option<f64>,
    low_hz: Option<f64>,
    high_hz: Option<f64>,
}

impl SpectrogramAsked {
    /// The part asked for, if one is.
    ///
    /// # Errors
    /// Its limits are incomplete, not finite or not ascending.
    fn part(&self) -> Result<Option<Part>, &'static str> {
        let limits = [self.from_s, self.to_s, self.low_hz, self.high_hz];
        if limits.iter().all(Option::is_none) {
            return Ok(None);
        }
        let [Some(from_s), Some(to_s), Some(low_hz), Some(high_hz)] = limits else {
            return Err("a part of a spectrogram needs from_s, to_s, low_hz and high_hz");
        };
        // Times within the range of nanoseconds.
        let valid = from_s.abs() < 9e9 && to_s.abs() < 9e9 && from_s < to_s && 0.0 <= low_hz && low_hz < high_hz;
        if !valid || high_hz > 1e6 {
            return Err("a part of a spectrogram begins before it ends, between 0 and 1 MHz");
        }
        let ns = |seconds: f64| (seconds * 1e9) as i64;
        Ok(Some(Part { from_ns: ns(from_s), to_ns: ns(to_s), low_hz, high_hz }))
    }
}

async fn sound(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    aside(move || json(serde_json::to_string(&source.sound()).unwrap_or_default())).await
}

async fn spectrogram(Extension(source): Extension<Arc<dyn Source>>, Query(asked): Query<SpectrogramAsked>) -> Response {
    let part = match asked.part() {
        Ok(part) => part,
        Err(reason) => return (StatusCode::BAD_REQUEST, reason).into_response(),
    };
    aside(move || match source.spectrogram(&asked.channel, part) {
        Some(picture) => {
            // Numbers only, so it is a valid header.
            let covers = serde_json::to_string(&picture.covers).unwrap_or_default();
            let headers =
                [(header::CONTENT_TYPE, "image/png".to_owned()), (HeaderName::from_static("x-covers"), covers)];
            (headers, picture.png()).into_response()
        }
        None => (StatusCode::NOT_FOUND, "no samples of this channel").into_response(),
    })
    .await
}

async fn events_csv(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    aside(move || {
        let headers = [
            (header::CONTENT_TYPE, "text/csv; charset=utf-8"),
            (header::CONTENT_DISPOSITION, "attachment; filename=\"squealcast-events.csv\""),
        ];
        (headers, source.events().to_csv()).into_response()
    })
    .await
}

async fn map(Extension(source): Extension<Arc<dyn Source>>, Query(asked): Query<MapAsked>) -> Response {
    aside(move || match source.map(asked.number) {
        Some(curves) => json(curves.to_string()),
        None => (StatusCode::NOT_FOUND, "no such stability map").into_response(),
    })
    .await
}

async fn shape(Extension(source): Extension<Arc<dyn Source>>, Query(asked): Query<ShapeAsked>) -> Response {
    aside(move || match source.shape(asked.id, asked.at) {
        Ok(shape) => json(shape),
        Err(reason) => (StatusCode::NOT_FOUND, reason).into_response(),
    })
    .await
}

async fn contact(Extension(source): Extension<Arc<dyn Source>>, Query(asked): Query<Moment>) -> Response {
    aside(move || match source.contact(asked.at) {
        Ok(contact) => json(contact),
        Err(reason) => (StatusCode::NOT_FOUND, reason).into_response(),
    })
    .await
}

async fn metrics_text(Extension(source): Extension<Arc<dyn Source>>) -> Response {
    aside(move || match source.metrics() {
        Some(text) => ([(header::CONTENT_TYPE, metrics::MEDIA_TYPE)], text).into_response(),
        None => (StatusCode::NOT_FOUND, "a recording has no metrics").into_response(),
    })
    .await
}

async fn asset(headers: HeaderMap, request: Request) -> Response {
    let Some(asset) = assets::find(request.uri().path().trim_start_matches('/')) else {
        return (StatusCode::NOT_FOUND, "no such page").into_response();
    };
    let accepted = headers.get(header::ACCEPT_ENCODING).and_then(|value| value.to_str().ok()).unwrap_or("");
    let media_type = (header::CONTENT_TYPE, asset.media_type);
    if takes_zstd(accepted) {
        ([media_type, (header::CONTENT_ENCODING, "zstd")], asset.compressed()).into_response()
    } else {
        ([media_type], asset.bytes).into_response()
    }
}

fn json(text: String) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], Body::from(text)).into_response()
}

/// Runs work that may take long on another thread than the one that sends states.
async fn aside(work: impl FnOnce() -> Response + Send + 'static) -> Response {
    match tokio::task::spawn_blocking(work).await {
        Ok(response) => response,
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
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
        for host in [
            "",
            "evil.example:8765",
            "127.0.0.1.evil.example",
            "192.168.1.5:8765",
            "[::1].evil.example",
            "[::1].evil.example:8765",
            "[::1]evil.example",
            "[::1",
            "[127.0.0.1]",
            "127.0.0.1:8765.evil.example",
            "localhost:8765.evil.example",
            "localhost:evil.example",
        ] {
            assert!(!is_own_name(host, loopback), "{host}");
        }
        assert!(is_own_name("192.168.1.5:8765", anywhere));
        assert!(!is_own_name("evil.example", anywhere));
    }

    #[test]
    fn an_encoding_of_weight_zero_is_not_taken() {
        for accepted in ["zstd", "gzip, zstd;q=0.5", "br;q=0, ZSTD ; q=1", "zstd;q=0.001"] {
            assert!(takes_zstd(accepted), "{accepted}");
        }
        for refused in ["", "gzip", "zstd;q=0", "gzip, zstd; q=0.000", "zstd;q=none", "zstdx"] {
            assert!(!takes_zstd(refused), "{refused}");
        }
    }
}
