//! Closing a link to a peer that has stopped reading must not hold up the others.
//!
//! Zenoh sets SO_LINGER to 10 s on its TCP sockets (`zenoh-link-tcp` 1.10.2, `TCP_LINGER_TIMEOUT`) and closes them on the
//! threads that serve all links. If the peer is frozen, bytes are left to send, and `close` blocks such a thread for 10 s
//! after the peer's lease: if it is the one of the runtime `Net`, this session receives nothing meanwhile, and what
//! others publish is dropped when their queues to us are full. Without the option the kernel sends the rest in the
//! background.

use ::zenoh::sample::SampleKind;
use ::zenoh::{Session, Wait};
use socket2::Type;

use super::super::sockets;

/// Switches SO_LINGER off for the links of this session, also for later ones.
pub(super) fn avoid(session: &Session) -> ::zenoh::Result<()> {
    let look = |event: ::zenoh::session::LinkEvent| {
        if event.kind() == SampleKind::Put {
            // Without /proc the links keep the option.
            let _ = sockets::each(Type::STREAM, |socket| socket.set_linger(None));
        }
    };
    session.info().link_events_listener().history(true).callback(look).background().wait()
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::thread;
    use std::time::{Duration, Instant};

    use ::zenoh::Config;

    use super::*;

    fn session(port: u16, place: &str) -> Session {
        let mut config = Config::default();
        let endpoint = format!("[\"tcp/127.0.0.1:{port}\"]");
        for (key, value) in [
            ("scouting/multicast/enabled", "false"),
            ("listen/endpoints", if place == "listen" { &endpoint } else { "[]" }),
            ("connect/endpoints", if place == "connect" { &endpoint } else { "[]" }),
        ] {
            config.insert_json5(key, value).expect(key);
        }
        ::zenoh::open(config).wait().expect("joined")
    }

    /// SO_LINGER of the TCP sockets of this process at this port.
    fn lingers(port: u16) -> Vec<Option<Duration>> {
        let mut found = vec![];
        let look = |socket: &socket2::SockRef<'_>| {
            let is_at = |address: socket2::SockAddr| address.as_socket().is_some_and(|address| address.port() == port);
            // A listening socket has no peer.
            if let Ok(peer) = socket.peer_addr()
                && (is_at(peer) || is_at(socket.local_addr()?))
            {
                found.push(socket.linger()?);
            }
            Ok(())
        };
        sockets::each(Type::STREAM, look).expect("/proc is mounted");
        found
    }

    /// Should the first half fail, Zenoh has mended it, and this file can go.
    #[test]
    fn links_do_not_linger_whether_they_are_older_or_newer() {
        let port = TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").port();
        let until = Instant::now() + Duration::from_secs(20);
        let reach = |expected: &[Option<Duration>]| {
            while lingers(port) != expected {
                assert!(Instant::now() < until, "{:?}, not {expected:?}", lingers(port));
                thread::sleep(Duration::from_millis(10));
            }
        };
        let listening = session(port, "listen");
        let _older = session(port, "connect");
        reach(&[Some(Duration::from_secs(10)); 2]);
        avoid(&listening).expect("watched");
        reach(&[None; 2]);
        let _newer = session(port, "connect");
        reach(&[None; 4]);
    }
}
