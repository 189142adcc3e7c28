//! SIGINT, SIGTERM and SIGHUP end a command cleanly. Further signals within 2 s are ignored; any later one ends it at once.
//! A node with a configuration file reads it again at SIGHUP instead.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use tokio::signal::unix::{Signal, SignalKind, signal};

/// Signals within this time of the first belong to the same request: a Ctrl-C reaches a launcher's whole process group,
/// the launcher then sends its own signals, and people press it more than once. A recording is finished within this time.
const SAME_REQUEST: Duration = Duration::from_secs(2);

/// Sleeps until `moment` or until `stopped` is set, which is checked ten times a second.
pub fn wait_until(moment: Instant, stopped: &AtomicBool) {
    while !stopped.load(Ordering::Relaxed) {
        let left = moment.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return;
        }
        std::thread::sleep(left.min(Duration::from_millis(100)));
    }
}

/// What SIGHUP does.
pub enum Hangup {
    /// It ends the program, as SIGTERM does: its terminal was closed.
    Stops,
    /// It calls this function, every time.
    Calls(Box<dyn FnMut() + Send>),
}

/// As [`on_signals`], where SIGHUP ends the program.
///
/// # Errors
/// Signal handlers cannot be installed.
pub fn on_stop(stop: impl FnOnce() + Send + 'static) -> anyhow::Result<()> {
    on_signals(Hangup::Stops, stop)
}

/// Calls `stop` once at the first signal that ends the program. Further ones within [`SAME_REQUEST`] are ignored; any
/// later one ends the process. SIGHUP is ignored if it was ignored when the process started (`nohup`).
///
/// # Errors
/// Signal handlers cannot be installed.
pub fn on_signals(hangup: Hangup, stop: impl FnOnce() + Send + 'static) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()
        .context("cannot start the signal listener")?;
    let mut stopping = vec![SignalKind::interrupt(), SignalKind::terminate()];
    let (mut calling, mut call) = (vec![], None);
    if !ignored_from_the_beginning(SignalKind::hangup()) {
        match hangup {
            Hangup::Stops => stopping.push(SignalKind::hangup()),
            Hangup::Calls(function) => {
                calling.push(SignalKind::hangup());
                call = Some(function);
            }
        }
    }
    let listen = |kinds: Vec<SignalKind>| kinds.into_iter().map(signal).collect::<Result<Vec<Signal>, _>>();
    let (mut stops, mut calls) =
        runtime.block_on(async { Ok::<_, std::io::Error>((listen(stopping)?, listen(calling)?)) })?;
    std::thread::spawn(move || {
        runtime.block_on(async {
            loop {
                tokio::select! {
                    () = any(&mut stops) => break,
                    () = any(&mut calls) => {
                        if let Some(call) = &mut call {
                            call();
                        }
                    }
                }
            }
            stop();
            let first = Instant::now();
            let mut said = false;
            loop {
                any(&mut stops).await;
                if first.elapsed() >= SAME_REQUEST {
                    std::process::exit(130);
                }
                if !std::mem::replace(&mut said, true) {
                    note!("finishing; a signal after 2 s ends this at once, and what was begun is not finished");
                }
            }
        });
    });
    Ok(())
}

/// Waits for any of several signals; forever if there are none.
async fn any(signals: &mut [Signal]) {
    std::future::poll_fn(|context| {
        // All are polled, so that each of them can wake this future.
        let came: Vec<bool> = signals.iter_mut().map(|signal| signal.poll_recv(context).is_ready()).collect();
        if came.contains(&true) { std::task::Poll::Ready(()) } else { std::task::Poll::Pending }
    })
    .await;
}

/// Whether a signal was ignored when the process started.
fn ignored_from_the_beginning(kind: SignalKind) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ignores(&status, kind.as_raw_value())
}

/// Whether a text of `/proc/PID/status` marks a signal as ignored: bit `n - 1` of a hexadecimal mask is signal `n`.
fn ignores(status: &str, signal: i32) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|digits| u64::from_str_radix(digits.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

/// Makes a write beyond the file size limit (`ulimit -f`) fail like one on a full disk, instead of ending the process.
///
/// # Errors
/// The signal handler cannot be installed.
pub fn survive_file_size_limit() -> std::io::Result<()> {
    signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::new(AtomicBool::new(false)))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ignored_signals_are_read_from_the_status_of_the_process() {
        let status = "Name:\tsquealcast\nSigBlk:\tffffffffffffffff\nSigIgn:\t0000000000001001\nSigCgt:\t0\n";
        let ignored: Vec<i32> = (1..=64).filter(|&signal| ignores(status, signal)).collect();
        assert_eq!(ignored, [1, 13], "SIGHUP and SIGPIPE");
        assert!(!ignores("", 1));
    }
}
