use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use anyhow::Context;
use clap::Args;

use super::{finite, not_negative};
use crate::display::comparison::Criteria;
use crate::display::live::Live;
use crate::display::server::{About, Pages, Server};
use crate::node::Watch;
use crate::rig::Rig;

/// Default port of the page; if it is taken, the next ports are tried.
const DEFAULT_PORT: u16 = 8765;
/// Number of ports that are tried.
const PORTS: u16 = 10;

/// Options of the page.
#[derive(Clone, Debug, Args)]
pub struct DisplayOptions {
    /// Serve the page on this address [default: 127.0.0.1:8765, or the next free port]
    #[arg(long, value_name = "ADDRESS")]
    display: Option<SocketAddr>,
    /// Serve no page
    #[arg(long, conflicts_with = "display")]
    no_display: bool,
    /// Let --display name an address that other machines can reach; everybody there can see the page
    #[arg(long)]
    display_anywhere: bool,
}

/// From which level on a measured vibration counts as squeal.
#[derive(Clone, Copy, Debug, Args)]
pub struct ThresholdOption {
    /// A vibration at or above this level counts as squeal [default: 70]
    #[arg(long, value_name = "DB", value_parser = finite, allow_negative_numbers = true)]
    vibration_threshold: Option<f64>,
}

impl ThresholdOption {
    /// The threshold, dB.
    pub fn db(&self) -> f64 {
        self.vibration_threshold.unwrap_or(Criteria::default().threshold_db)
    }
}

/// What counts as a hit, a miss, and a false alarm.
#[derive(Clone, Copy, Debug, Args)]
pub struct CriteriaOptions {
    #[command(flatten)]
    threshold: ThresholdOption,
    /// Minimum duration of a measured squeal in seconds [default: 0.1]
    #[arg(long, value_name = "S", value_parser = not_negative)]
    vibration_duration: Option<f64>,
    /// A prediction also counts this many seconds before its onset and after its end [default: 0.5]
    #[arg(long, value_name = "S", value_parser = not_negative)]
    time_tolerance: Option<f64>,
    /// Largest relative difference between a measured and a predicted frequency that match [default: 0.05]
    #[arg(long, value_name = "SHARE", value_parser = not_negative)]
    frequency_tolerance: Option<f64>,
}

impl CriteriaOptions {
    /// The criteria given, with defaults for the others.
    pub fn criteria(&self) -> Criteria {
        let usual = Criteria::default();
        Criteria {
            threshold_db: self.threshold.db(),
            least_duration_s: self.vibration_duration.unwrap_or(usual.least_duration_s),
            time_tolerance_s: self.time_tolerance.unwrap_or(usual.time_tolerance_s),
            frequency_tolerance: self.frequency_tolerance.unwrap_or(usual.frequency_tolerance),
        }
    }
}

impl DisplayOptions {
    /// The addresses to try in order; empty without a page.
    ///
    /// # Errors
    /// An address reachable by others, without the option that allows it.
    pub fn addresses(&self) -> anyhow::Result<Vec<SocketAddr>> {
        match self.display {
            _ if self.no_display => Ok(vec![]),
            Some(address) if !address.ip().is_loopback() && !self.display_anywhere => {
                anyhow::bail!("--display is {address}, expected a loopback address; --display-anywhere allows any")
            }
            Some(address) => Ok(vec![address]),
            None => Ok((0..PORTS).map(|k| (Ipv4Addr::LOCALHOST, DEFAULT_PORT + k).into()).collect()),
        }
    }
}

/// Serves `pages` on the first free address of `addresses` and reports it; does nothing without addresses.
///
/// # Errors
/// None of the addresses is free.
pub fn serve(addresses: &[SocketAddr], pages: Pages) -> anyhow::Result<Option<Server>> {
    let Some(first) = addresses.first() else { return Ok(None) };
    let server = Server::start(addresses, pages)
        .with_context(|| format!("no display on {first}; another address with --display, none with --no-display"))?;
    note!("display: http://{}/", server.address());
    Ok(Some(server))
}

impl DisplayOptions {
    /// Serves the page of a node. An address given by the user must be free. If none of the default addresses is free,
    /// the node runs without a page.
    ///
    /// # Errors
    /// The address given by the user is taken.
    pub fn of_node(&self, rig: &Arc<Rig>, watch: &Watch, about: About) -> anyhow::Result<Option<Server>> {
        let live = Live::new(rig.clone(), watch.clone(), about);
        match serve(&self.addresses()?, Pages::One(Arc::new(live))) {
            Err(error) if self.display.is_none() => {
                note!("warning: {}", super::failure(&error));
                Ok(None)
            }
            served => served,
        }
    }
}
