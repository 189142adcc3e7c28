//! The sockets of this process, for options that a library does not let us choose.

use std::fs;
use std::io;
use std::os::fd::{BorrowedFd, RawFd};

use socket2::{SockRef, Type};

/// Calls `change` for every socket of this process of this type over IP.
///
/// # Errors
/// `/proc` is not mounted, or the first error of `change`.
pub(super) fn each(wanted: Type, mut change: impl FnMut(&SockRef<'_>) -> io::Result<()>) -> io::Result<()> {
    // Collected first, because the open directory is itself a descriptor.
    let names = fs::read_dir("/proc/self/fd")?.map(|entry| Ok(entry?.file_name())).collect::<io::Result<Vec<_>>>()?;
    for number in names.iter().filter_map(|name| name.to_str()?.parse::<RawFd>().ok()) {
        // SAFETY: the descriptor is only queried, and gets an option if it is such a socket; nothing is read, written or
        // closed. One that another thread closes in the meantime gives EBADF, or is another socket of this process.
        let descriptor = unsafe { BorrowedFd::borrow_raw(number) };
        let socket = SockRef::from(&descriptor);
        let is_internet = || socket.local_addr().is_ok_and(|address| address.is_ipv4() || address.is_ipv6());
        if socket.r#type().is_ok_and(|found| found == wanted) && is_internet() {
            change(&socket)?;
        }
    }
    Ok(())
}
