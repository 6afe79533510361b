//! How much memory there is, how much is in use, and what people call it.

/// Bytes of `2GB`, `4GiB`, `500M`, `1073741824`: decimal for B, binary for iB.
pub fn parse_bytes(text: &str) -> Option<u64> {
    let text = text.trim();
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let number: f64 = text[..end].parse().ok()?;
    let unit = match text[end..].trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kb" => 1e3,
        "m" | "mb" => 1e6,
        "g" | "gb" => 1e9,
        "t" | "tb" => 1e12,
        "ki" | "kib" => 1024.0,
        "mi" | "mib" => 1048576.0,
        "gi" | "gib" => 1073741824.0,
        "ti" | "tib" => 1099511627776.0,
        _ => return None,
    };
    let bytes = number * unit;
    (bytes.is_finite() && bytes >= 1.0).then_some(bytes as u64)
}

/// Memory that a build takes when nobody says: a third of the machine's, 4 GB where that is not known.
pub fn default_bytes() -> u64 {
    field("/proc/meminfo", "MemTotal:").map_or(4_000_000_000, |total| total / 3)
}

/// Memory this process holds, bytes; none where the system does not tell.
pub fn in_use() -> Option<u64> {
    field("/proc/self/status", "VmRSS:")
}

fn field(path: &str, name: &str) -> Option<u64> {
    let text = std::fs::read_to_string(path).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    line.trim().trim_end_matches("kB").trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_people_write_them() {
        for (text, bytes) in
            [("2GB", 2_000_000_000), ("4GiB", 4 << 30), ("500M", 500_000_000), ("1.5 gb", 1_500_000_000), ("77", 77)]
        {
            assert_eq!(parse_bytes(text), Some(bytes), "{text}");
        }
        for text in ["", "GB", "2 apples", "-1GB", "0", "1e9"] {
            assert_eq!(parse_bytes(text), None, "{text}");
        }
    }

    #[test]
    fn this_process_uses_some_memory() {
        if let Some(bytes) = in_use() {
            assert!((1 << 20..1 << 40).contains(&bytes), "{bytes}");
        }
    }
}
