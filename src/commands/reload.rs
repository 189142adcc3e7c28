//! Reads the configuration file of a running node again. Settings that it changes take effect at once, as session events;
//! everything else is named and takes effect with the next start.

use std::io::IsTerminal;
use std::sync::Arc;

use anyhow::{Context, bail};

use super::buses::NodeStart;
use super::config::{Config, Given};
use super::signals::Hangup;
use super::{Command, failure, service};
use crate::node::{Incoming, Inlet, Watch};
use crate::rig::Rig;
use crate::session::settings::Settings;

/// A configuration file that is read again.
pub struct Reload {
    given: Given,
    /// What the node was started with.
    config: Config,
    rig: Arc<Rig>,
}

/// What a file says when it is read again.
struct Changes {
    /// Settings that differ from those in force: name, value in force, new value.
    settings: Vec<(&'static str, f64, f64)>,
    /// Keys that need a restart.
    at_next_start: Vec<String>,
}

impl Reload {
    pub fn new(given: Given, config: Config, rig: &Arc<Rig>) -> Self {
        Self { given, config, rig: rig.clone() }
    }

    /// What SIGHUP does to a node that started with `settings`. A node at a terminal ends, since its terminal was closed.
    pub fn at_hangup(reload: Option<Self>, settings: Settings, watch: &Watch, node: &Inlet) -> Hangup {
        let Some(reload) = reload.filter(|_| !std::io::stdin().is_terminal()) else { return Hangup::Stops };
        let (watch, node) = (watch.clone(), node.clone());
        Hangup::Calls(Box::new(move || {
            let in_force = watch.snapshot().settings.unwrap_or(settings);
            service::reloading(|| reload.apply(&in_force, &node));
        }))
    }

    /// Applies what the file says now. A faulty file changes nothing.
    fn apply(&self, in_force: &Settings, node: &Inlet) {
        let file = self.config.file.display();
        match self.changes(in_force) {
            Ok(Changes { settings, at_next_start }) => {
                for (name, before, value) in &settings {
                    note!("{file}: {name} is now {value}, was {before}");
                    node.send(Incoming::Parameter { name: (*name).to_owned(), value: *value });
                }
                if !at_next_start.is_empty() {
                    note!("{file}: takes effect with the next start: {}", at_next_start.join(", "));
                }
                if settings.is_empty() && at_next_start.is_empty() {
                    note!("{file}: read again, nothing has changed");
                }
            }
            Err(error) => note!("error: nothing is changed: {}", failure(&error)),
        }
    }

    /// The changes that the file makes to a node with the settings `in_force`.
    ///
    /// # Errors
    /// A node could not start with this file.
    fn changes(&self, in_force: &Settings) -> anyhow::Result<Changes> {
        let (cli, ros_args, config) = self.given.with_file(&self.config.file)?;
        let Command::Run(options) = cli.command else { bail!("the command is another one") };
        let NodeStart { settings, .. } =
            options.start(&self.rig, ros_args).context(self.config.file.display().to_string())?;
        let pairs = in_force.values().zip(settings.values());
        let settings = pairs.filter(|((_, before), (_, value))| before != value);
        let at_next_start = config.differences(&self.config).into_iter().filter(|key| *key != "set");
        Ok(Changes {
            settings: settings.map(|((name, before), (_, value))| (name, before, value)).collect(),
            at_next_start: at_next_start.map(str::to_owned).collect(),
        })
    }
}
