//! Memory of this process and of the machine, as reported by Linux.

/// Resident memory of this process, bytes; `None` if the system does not report it.
pub fn resident_bytes() -> Option<usize> {
    kilobytes("/proc/self/status", "VmRSS:")
}

/// Largest resident memory of this process so far, bytes; `None` if the system does not report it.
pub fn peak_bytes() -> Option<usize> {
    kilobytes("/proc/self/status", "VmHWM:")
}

/// Memory available on the machine without swapping, bytes; `None` if the system does not report it.
pub fn available_bytes() -> Option<usize> {
    kilobytes("/proc/meminfo", "MemAvailable:")
}

/// The value after `key` in a file of lines, converted from kB to bytes.
fn kilobytes(file: &str, key: &str) -> Option<usize> {
    let text = std::fs::read_to_string(file).ok()?;
    let value = text.lines().find_map(|line| line.strip_prefix(key))?;
    value.trim().strip_suffix("kB")?.trim().parse::<usize>().ok()?.checked_mul(1024)
}
