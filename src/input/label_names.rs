//! What the label numbers of a PLY file mean, as its header says: `comment label 3 building`.
//!
//! SUM and CGAL write such comments, and so do we. A file without them has SUM's numbering.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use crate::ids::ClassScheme;
use crate::{Error, Result};

/// Numbers and names of labels.
pub type Names = Vec<(i16, String)>;

/// A header is a few hundred bytes.
const MOST_BYTES: u64 = 1 << 20;

/// SUM's numbering (Gao et al. 2021), with the words of its paper.
const SUM: [(i16, &str); 8] = [
    (-1, "unclassified"),
    (0, "unclassified"),
    (1, "terrain"),
    (2, "high vegetation"),
    (3, "building"),
    (4, "water"),
    (5, "vehicle"),
    (6, "boat"),
];

/// The names in the headers of those of `files` that are PLY, of each number the first; SUM's where there are none.
///
/// # Errors
/// [`Error::Io`] for a file that cannot be read.
pub fn names(files: &[PathBuf]) -> Result<Names> {
    let names = in_headers(files)?;
    Ok(if names.is_empty() { SUM.map(|(number, name)| (number, name.into())).to_vec() } else { names })
}

/// What `labels` mean that came from `files` or stood in a bare list: the headers' names, else those of the classes of
/// `scheme` if the numbers look like their ids (0 is among them, and none is beyond the last), else SUM's.
///
/// # Errors
/// [`Error::Io`] for a file that cannot be read.
pub fn names_of(labels: &[i16], files: &[PathBuf], scheme: &ClassScheme) -> Result<Names> {
    let named = in_headers(files)?;
    let are_ids =
        labels.contains(&0) && labels.iter().all(|l| usize::try_from(*l).map_or(*l == -1, |l| l < scheme.len()));
    if !named.is_empty() || !are_ids {
        return if named.is_empty() { names(&[]) } else { Ok(named) };
    }
    Ok(scheme.ids().map(|id| (i16::from(id.0), scheme[id].name.clone())).collect())
}

fn in_headers(files: &[PathBuf]) -> Result<Names> {
    let mut names = Names::new();
    for path in files.iter().filter(|p| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"))) {
        for (number, name) in in_header(path)? {
            if !names.iter().any(|n| n.0 == number) {
                names.push((number, name));
            }
        }
    }
    Ok(names)
}

fn in_header(path: &Path) -> Result<Names> {
    let file = std::fs::File::open(path).map_err(Error::io("read", path))?;
    let mut lines = BufReader::new(file.take(MOST_BYTES));
    let (mut names, mut line) = (Names::new(), Vec::new());
    loop {
        line.clear();
        let read = lines.read_until(b'\n', &mut line).map_err(Error::io("read", path))?;
        let text = String::from_utf8_lossy(&line);
        if read == 0 || text.trim() == "end_header" {
            return Ok(names);
        }
        let mut words = text.split_whitespace();
        if words.next() == Some("comment")
            && words.next().is_some_and(|w| w.eq_ignore_ascii_case("label"))
            && let Some(number) = words.next().and_then(|w| w.parse().ok())
        {
            names.push((number, words.collect::<Vec<_>>().join(" ")));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_without_names_are_class_ids_if_they_look_like_them() {
        let scheme = ClassScheme::default();
        let first = |labels: &[i16]| names_of(labels, &[], &scheme).unwrap();
        assert_eq!(first(&[3, 0, -1])[2], (2, scheme.0[2].name.clone()));
        assert_eq!(first(&[3, 1]), names(&[]).unwrap());
        assert_eq!(first(&[0, 5]), names(&[]).unwrap(), "SUM has 0 for what is not classified");
    }

    #[test]
    fn names_come_from_comments_else_from_sum() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, text: &str| {
            std::fs::write(folder.path().join(name), text).unwrap();
            folder.path().join(name)
        };
        let named = file(
            "a.ply",
            "ply\ncomment Label 0 bare ground\ncomment made by hand\ncomment label x y\nend_header\ncomment label 9 no\n",
        );
        let bare = file("b.ply", "ply\nformat ascii 1.0\nend_header\n");
        assert_eq!(names(&[bare.clone(), named]).unwrap(), [(0, "bare ground".to_owned())]);
        assert_eq!(names(&[bare, "scan.obj".into()]).unwrap()[4], (3, "building".to_owned()));
        assert_eq!(names(&[folder.path().join("gone.ply")]).unwrap_err().exit_code(), 3);
    }
}
