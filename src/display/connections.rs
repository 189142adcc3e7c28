//! The connections of browsers: limited in number, and none can keep others out.
//!
//! A connection is closed if a request takes too long to arrive, if the client stops reading, or if nothing was sent
//! over it for a while. Bytes sent by the client do not extend these times. At the limit, a new connection replaces the
//! one to which nothing was sent for the longest time.

use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::oneshot;
use tokio::time::{Instant, Sleep, sleep};

/// Limits for a client.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    /// Number of simultaneous connections.
    pub connections: usize,
    /// Time for the header of a request, from the opening of the connection or the end of the previous answer.
    pub request: Duration,
    /// Time without the client taking any of the bytes waiting for it.
    pub patience: Duration,
    /// Time without anything being sent to the client; longer than any answer takes to prepare.
    pub idle: Duration,
}

impl Default for Bounds {
    fn default() -> Self {
        let [request, patience, idle] = [10, 10, 60].map(Duration::from_secs);
        Self { connections: 128, request, patience, idle }
    }
}

/// Send buffer of the system for a client, bytes. The usual megabytes would hide for a minute that it does not read.
const SEND_BUFFER: u32 = 128 * 1024;
/// Largest request, bytes; those of the page have a few hundred.
const MOST_REQUEST_BYTES: usize = 16 * 1024;
/// Connections that the system holds until they are accepted.
const BACKLOG: u32 = 1024;

/// Listens on the first free address of `addresses`.
///
/// # Errors
/// The error for the last address, if none is free.
pub fn listen(addresses: &[SocketAddr]) -> io::Result<TcpListener> {
    let mut refused = io::ErrorKind::InvalidInput.into();
    for &address in addresses {
        let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
        socket.set_reuseaddr(true)?;
        // Accepted connections inherit this setting.
        socket.set_send_buffer_size(SEND_BUFFER)?;
        match socket.bind(address).and_then(|()| socket.listen(BACKLOG)) {
            Ok(listener) => return Ok(listener),
            Err(error) => refused = error,
        }
    }
    Err(refused)
}

/// Answers requests with `router` until the future is dropped.
pub async fn serve(listener: TcpListener, router: Router, bounds: Bounds) {
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(bounds.request).max_buf_size(MOST_REQUEST_BYTES);
    let mut open = Open { places: vec![], began: Instant::now(), bounds };
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                let _ = stream.set_nodelay(true);
                let stream = TokioIo::new(open.admit(stream));
                // An error ends its own connection only.
                tokio::spawn(http.serve_connection(stream, TowerToHyperService::new(router.clone())));
            }
            // No file descriptors are left, or the client has disconnected.
            Err(_) => sleep(Duration::from_millis(50)).await,
        }
    }
}

/// The open connections, oldest first.
struct Open {
    places: Vec<Place>,
    began: Instant,
    bounds: Bounds,
}

/// Entry of an open connection; dropping it closes the connection.
struct Place {
    /// When something was sent last, microseconds after [`Open::began`] and at least 1; 0 before the first answer.
    sent_us: Arc<AtomicU64>,
    held: oneshot::Sender<Infallible>,
}

impl Open {
    /// Registers a new connection. At the limit it replaces another one: the oldest of those that were never answered,
    /// else the one to which nothing was sent for the longest time.
    fn admit(&mut self, stream: TcpStream) -> Bounded {
        self.places.retain(|place| !place.held.is_closed());
        if self.places.len() >= self.bounds.connections {
            let sent = |place: &Place| place.sent_us.load(Ordering::Relaxed);
            let stalest = (0..self.places.len()).min_by_key(|&k| sent(&self.places[k]));
            stalest.map(|k| self.places.remove(k));
        }
        let (held, evicted) = oneshot::channel();
        let sent_us = Arc::new(AtomicU64::new(0));
        self.places.push(Place { sent_us: sent_us.clone(), held });
        let Bounds { patience, idle, .. } = self.bounds;
        let alone = Box::pin(sleep(idle));
        Bounded { stream, sent_us, began: self.began, evicted, over: false, waiting: None, patience, alone, idle }
    }
}

/// A connection whose operations fail once a time limit is exceeded.
struct Bounded {
    stream: TcpStream,
    sent_us: Arc<AtomicU64>,
    began: Instant,
    evicted: oneshot::Receiver<Infallible>,
    over: bool,
    /// Expires when the client has taken nothing for too long.
    waiting: Option<Pin<Box<Sleep>>>,
    patience: Duration,
    /// Expires when nothing has been sent for too long.
    alone: Pin<Box<Sleep>>,
    idle: Duration,
}

impl Bounded {
    /// Whether a time limit is exceeded or the connection was replaced.
    fn is_over(&mut self, context: &mut Context<'_>) -> bool {
        // The channel must not be polled again after it has answered.
        self.over = self.over
            || Pin::new(&mut self.evicted).poll(context).is_ready()
            || self.alone.as_mut().poll(context).is_ready();
        self.over
    }

    fn judge(&mut self, written: Poll<io::Result<usize>>, context: &mut Context<'_>) -> Poll<io::Result<usize>> {
        if written.is_ready() {
            self.waiting = None;
            let now = Instant::now();
            self.alone.as_mut().reset(now + self.idle);
            let sent_us = (now - self.began).as_micros().max(1);
            self.sent_us.store(u64::try_from(sent_us).unwrap_or(u64::MAX), Ordering::Relaxed);
            return written;
        }
        let patience = self.patience;
        let waiting = self.waiting.get_or_insert_with(|| Box::pin(sleep(patience)));
        if waiting.as_mut().poll(context).is_ready() || self.is_over(context) { too_late() } else { Poll::Pending }
    }
}

fn too_late<T>() -> Poll<io::Result<T>> {
    Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
}

impl AsyncRead for Bounded {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if self.is_over(cx) { too_late() } else { Pin::new(&mut self.stream).poll_read(cx, buffer) }
    }
}

impl AsyncWrite for Bounded {
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
    use std::io::{Read, Write};
    use std::net::TcpStream;
    use std::sync::mpsc;

    use axum::body::Body;
    use axum::routing::get;

    use super::*;

    /// Longer than any test takes.
    const NEVER: Duration = Duration::from_secs(3600);
    /// How long a test waits for an event that must occur.
    const LONG: Duration = Duration::from_secs(60);
    const SOON: Duration = Duration::from_millis(300);

    /// A server with an answer at `/` and an endless one at `/endless`; it ends with the test's runtime.
    struct Served {
        address: SocketAddr,
        /// Notified when an endless answer is dropped.
        given_up: mpsc::Receiver<()>,
        _runtime: tokio::runtime::Runtime,
    }

    /// Sends a notification when it is dropped.
    struct Guard(mpsc::Sender<()>);

    impl Drop for Guard {
        fn drop(&mut self) {
            let _ = self.0.send(());
        }
    }

    impl Served {
        fn start(bounds: Bounds) -> Self {
            let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
            let (ended, given_up) = mpsc::channel();
            let endless = move || {
                let guard = Guard(ended.clone());
                let chunk = move || {
                    let _kept = &guard;
                    Ok::<_, Infallible>(vec![0u8; 1 << 16])
                };
                std::future::ready(Body::from_stream(tokio_stream::iter(std::iter::repeat_with(chunk))))
            };
            let router = Router::new().route("/", get(|| async { "here" })).route("/endless", get(endless));
            let address = runtime.block_on(async {
                let listener = listen(&[([127, 0, 0, 1], 0).into()]).unwrap();
                let address = listener.local_addr().unwrap();
                tokio::spawn(serve(listener, router, bounds));
                address
            });
            Self { address, given_up, _runtime: runtime }
        }

        fn connect(&self) -> TcpStream {
            let stream = TcpStream::connect(self.address).unwrap();
            stream.set_read_timeout(Some(LONG)).unwrap();
            stream
        }
    }

    fn ask(stream: &mut TcpStream, path: &str) {
        write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    }

    /// Requests `/` and reads the answer.
    fn is_answered(stream: &mut TcpStream) -> bool {
        ask(stream, "/");
        let mut answer = vec![];
        let mut byte = [0];
        while !answer.ends_with(b"\r\n\r\nhere") {
            if !stream.read(&mut byte).is_ok_and(|count| count == 1) {
                return false;
            }
            answer.push(byte[0]);
        }
        answer.starts_with(b"HTTP/1.1 200")
    }

    fn waits(error: &io::Error) -> bool {
        matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut)
    }

    /// Whether the other end has closed the connection.
    fn is_closed(stream: &mut TcpStream) -> bool {
        match stream.read(&mut [0]) {
            Ok(count) => count == 0,
            Err(error) => !waits(&error),
        }
    }

    fn patient() -> Bounds {
        Bounds { connections: 4, request: NEVER, patience: NEVER, idle: NEVER }
    }

    #[test]
    fn a_request_that_comes_byte_by_byte_is_given_up() {
        for bounds in [Bounds { request: SOON, ..patient() }, Bounds { idle: SOON, ..patient() }] {
            let served = Served::start(bounds);
            let mut slow = served.connect();
            slow.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
            slow.write_all(b"GET / HTTP/1.1\r\nX-Slow: ").unwrap();
            let asked = std::time::Instant::now();
            loop {
                // Send one byte before each check whether the connection is closed.
                if slow.write_all(b"x").is_err() || !slow.read(&mut [0; 64]).is_err_and(|error| waits(&error)) {
                    break;
                }
                assert!(asked.elapsed() < LONG, "still open with {bounds:?}");
            }
        }
    }

    #[test]
    fn a_client_that_stops_reading_is_dropped() {
        let served = Served::start(Bounds { patience: SOON, ..patient() });
        let mut stalled = served.connect();
        ask(&mut stalled, "/endless");
        assert_eq!(served.given_up.recv_timeout(LONG), Ok(()));
    }

    #[test]
    fn silent_connections_do_not_block_others() {
        let served = Served::start(patient());
        let mut used = served.connect();
        assert!(is_answered(&mut used));
        let mut silent: Vec<TcpStream> = (0..20).map(|_| served.connect()).collect();
        assert!(is_answered(&mut served.connect()));
        for dropped in &mut silent[..17] {
            assert!(is_closed(dropped), "more connections than the bound are open");
        }
        assert!(is_answered(&mut used), "an answered connection ranks before one without a request");
    }

    #[test]
    fn of_connections_in_use_the_one_without_progress_gives_way() {
        let served = Served::start(patient());
        let mut used: Vec<TcpStream> = (0..4).map(|_| served.connect()).collect();
        assert!(used.iter_mut().all(is_answered));
        assert!(is_answered(&mut used[0]));
        assert!(is_answered(&mut served.connect()));
        assert!(is_closed(&mut used[1]));
        assert!(is_answered(&mut used[0]));
    }
}
