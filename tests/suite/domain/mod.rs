//! DDS domains that no other process on this machine uses.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::sync::atomic::{AtomicU16, Ordering};

/// A domain reserved as long as this value lives, also against other tests and other test runs on this machine.
pub struct Domain {
    pub id: u16,
    _claim: UnixListener,
}

/// Not 0, the default, and below 102: the ports of higher ones are those that Linux gives to anybody.
const FIRST: u16 = 1;
const LAST: u16 = 101;

impl Domain {
    /// Takes one that is free, each time another one: DDS remembers killed peers for a minute. Where to begin differs
    /// from process to process.
    pub fn claim() -> Self {
        static CLAIMED: AtomicU16 = AtomicU16::new(0);
        let count = LAST - FIRST + 1;
        let begin = (std::process::id() % u32::from(count)) as u16 + CLAIMED.fetch_add(1, Ordering::Relaxed);
        let free = (0..count).find_map(|k| Self::take(FIRST + (begin + k) % count));
        free.expect("a free domain: are there 101 tests running?")
    }

    /// This domain, unless it is taken. The name of a socket is held by the kernel until its process ends, however it does.
    pub fn take(id: u16) -> Option<Self> {
        let name = SocketAddr::from_abstract_name(format!("squealcast-test-domain-{id}")).expect("a name");
        UnixListener::bind_addr(&name).ok().map(|claim| Self { id, _claim: claim })
    }
}
