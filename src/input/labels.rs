//! Reads a list of labels: one integer a line.

use std::path::Path;

use crate::error::Place;
use crate::{Error, Result};

/// The integers in the file at `path`, one a line, in order; empty lines and lines that begin with `#` are passed over.
///
/// # Errors
/// [`Error::Io`], and [`Error::Input`] with the line that is not an integer of 16 bits.
pub fn read(path: &Path) -> Result<Vec<i16>> {
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    let mut labels = Vec::new();
    for (i, line) in bytes.split(|b| *b == b'\n').enumerate() {
        let line = line.trim_ascii();
        if line.is_empty() || line.starts_with(b"#") {
            continue;
        }
        let label = std::str::from_utf8(line).ok().and_then(|text| text.parse().ok());
        labels.push(label.ok_or_else(|| {
            let found: String = String::from_utf8_lossy(line).chars().take(20).collect();
            let what = format!("{found:?} is no label; wanted one integer of -32768 to 32767 a line");
            Error::input_at(path, Place::Line(i as u64 + 1), what)
        })?);
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_stand_one_a_line_and_anything_else_is_named_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("labels.txt");
        std::fs::write(&path, "# mine\n0\r\n-1\n\n 7 \n").unwrap();
        assert_eq!(read(&path).unwrap(), [0, -1, 7]);
        std::fs::write(&path, "0\n1\nroof\n").unwrap();
        let error = read(&path).unwrap_err();
        assert_eq!(error.exit_code(), 3);
        assert!(error.to_string().contains("line 3") && error.to_string().contains("roof"), "{error}");
        std::fs::write(&path, b"0\n\xff\xfe\n99999\n").unwrap();
        assert!(read(&path).is_err());
        assert!(read(&folder.path().join("none")).is_err());
    }
}
