//! Memory of this process and of the machine, as Linux tells it.

/// Bytes this process has in memory; `None` where the system does not say.
pub fn resident_bytes() -> Option<usize> {
    kilobytes("/proc/self/status", "VmRSS:")
}

/// The most bytes this process has had in memory; `None` where the system does not say.
pub fn peak_bytes() -> Option<usize> {
    kilobytes("/proc/self/status", "VmHWM:")
}

/// Bytes the machine can still give without swapping; `None` where the system does not say.
pub fn available_bytes() -> Option<usize> {
    kilobytes("/proc/meminfo", "MemAvailable:")
}

/// The number after `key` in a file of lines, in bytes.
fn kilobytes(file: &str, key: &str) -> Option<usize> {
    let text = std::fs::read_to_string(file).ok()?;
    let value = text.lines().find_map(|line| line.strip_prefix(key))?;
    value.trim().strip_suffix("kB")?.trim().parse::<usize>().ok()?.checked_mul(1024)
}
