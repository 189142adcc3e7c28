//! The option that starts a server for Foxglove.

use std::net::{Ipv4Addr, SocketAddr};

use clap::Args;

/// The server for Foxglove
#[derive(Clone, Copy, Debug, Default, Args)]
pub struct FoxgloveOption {
    /// Serve Foxglove over WebSocket on this port of 127.0.0.1, or on an address; every program that can connect can
    /// read, and set the parameters of a node
    #[arg(long, value_name = "PORT", value_parser = address)]
    pub foxglove: Option<SocketAddr>,
}

/// Reports where the server listens.
pub fn announce(address: SocketAddr, port: u16) {
    note!("Foxglove: ws://{}/", SocketAddr::new(address.ip(), port));
}

/// A port of the loopback address, or an address with its port.
fn address(text: &str) -> Result<SocketAddr, String> {
    let port = text.parse().map(|port: u16| (Ipv4Addr::LOCALHOST, port).into());
    port.or_else(|_| text.parse())
        .map_err(|_| "expected a port such as 8766, or an address such as 192.168.0.7:8766".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_is_one_of_this_machine() {
        assert_eq!(address("8766").expect("a port").to_string(), "127.0.0.1:8766");
        assert_eq!(address("[::1]:8766").expect("an address").to_string(), "[::1]:8766");
        assert!(address("localhost").is_err() && address("65536").is_err());
    }
}
