//! Restricts the UDP sockets of this process to the loopback interface.
//!
//! RustDDS can announce itself on 127.0.0.1 only, but it binds its sockets to 0.0.0.0, where every machine on the
//! network can reach them. With the sockets bound to the device `lo` (`SO_BINDTODEVICE`, Linux 5.7 or later without
//! privileges), the kernel drops everything that arrives through other interfaces.

use std::io;

use socket2::Type;

use crate::bus::sockets;

/// Binds every UDP socket of this process to `lo`. Datagrams that arrived before are still read.
///
/// # Errors
/// `/proc` is not mounted, or the kernel refuses.
pub(super) fn keep_to_loopback() -> io::Result<()> {
    sockets::each(Type::DGRAM, |socket| socket.bind_device(Some(b"lo")))
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use socket2::SockRef;

    use super::*;

    #[test]
    fn udp_sockets_are_bound_to_the_loopback_interface_and_others_are_left_alone() {
        let udp = UdpSocket::bind("0.0.0.0:0").expect("bound");
        let tcp = std::net::TcpListener::bind("127.0.0.1:0").expect("bound");
        keep_to_loopback().expect("permitted");
        assert_eq!(SockRef::from(&udp).device().expect("asked").as_deref(), Some(&b"lo"[..]));
        assert_eq!(SockRef::from(&tcp).device().expect("asked"), None);
        let port = udp.local_addr().expect("bound").port();
        let sender = UdpSocket::bind("127.0.0.1:0").expect("bound");
        sender.send_to(b"here", ("127.0.0.1", port)).expect("sent");
        let mut bytes = [0; 8];
        udp.set_read_timeout(Some(std::time::Duration::from_secs(10))).expect("set");
        assert_eq!(udp.recv(&mut bytes).expect("received"), 4, "the loopback interface serves it");
    }
}
