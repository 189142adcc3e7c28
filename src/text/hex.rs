//! Hexadecimal digits of hashes.

/// Bytes in hexadecimal digits, as hashes are written in files and messages.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
