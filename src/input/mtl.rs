//! Reads MTL files: the colour and the image of every material an OBJ names.
//!
//! In: the `mtllib` lines of an OBJ. Out: a [`Material`] per name asked for. Only `Kd` and `map_Kd` are of use to a
//! photogrammetry mesh; the rest of the format is skipped.
//! # Promises
//! Files are only looked for inside the input's folder ([`super::path`]), and an image only if a face needs it.
//! What is missing is a counted warning and grey; what leaves the folder is an error.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::lines::{self, Numbers, split_word, trim, without_comment};
use super::path::{Refusal, Resolver};
use super::{DEFAULT_COLOR, ImageRef, InputConfig, Material};
use crate::error::Place;
use crate::report::Reporter;
use crate::{Error, Result};

/// The largest MTL read, bytes; a thousand materials take about 0.1 MB.
const SIZE_LIMIT_BYTES: u64 = 256 << 20;
/// The most words of one file name on a `mtllib` line that holds several names.
const NAME_WORDS: usize = 16;
/// The most look-ups spent on such lines in one OBJ.
const LOOKUP_LIMIT: usize = 10_000;

/// One `newmtl`.
#[derive(Debug, Clone, PartialEq)]
struct Entry {
    name: String,
    color: [u8; 3],
    /// Line, and what follows `map_Kd`.
    map: Option<(u32, Vec<u8>)>,
}

/// The materials an OBJ's libraries define.
pub(super) struct Libraries<'a> {
    obj: &'a Path,
    reporter: &'a Reporter,
    resolver: Resolver,
    lookups_left: usize,
    files: Vec<PathBuf>,
    seen: HashSet<PathBuf>,
    /// With the number of the file.
    entries: Vec<(usize, Entry)>,
    by_name: HashMap<String, usize>,
    images: HashMap<PathBuf, u32>,
}

impl<'a> Libraries<'a> {
    /// No materials yet; paths are relative to the folder of `obj`, or of the MTL that names them.
    pub fn new(obj: &'a Path, config: &InputConfig, reporter: &'a Reporter) -> Result<Self> {
        let root = config.root.as_deref().unwrap_or(folder_of(obj));
        Ok(Self {
            obj,
            reporter,
            resolver: Resolver::new(root, config.allow_outside)?,
            lookups_left: LOOKUP_LIMIT,
            files: Vec::new(),
            seen: HashSet::new(),
            entries: Vec::new(),
            by_name: HashMap::new(),
            images: HashMap::new(),
        })
    }

    /// Reads the files named after `mtllib` on line `line`: one name with spaces, or several names.
    ///
    /// # Errors
    /// A path that leaves the folder; a file that is no text; I/O.
    pub fn load(&mut self, line: u64, rest: &[u8]) -> Result<()> {
        let words: Vec<&[u8]> =
            without_comment(rest).split(|&b| lines::is_space(b)).filter(|w| !w.is_empty()).collect();
        match find(&mut self.resolver, folder_of(self.obj), rest) {
            Ok(path) => return self.read(path),
            Err((refusal, name)) if words.len() < 2 && !matches!(refusal, Refusal::Missing) => {
                return Err(refusal.into_error(self.obj, Place::Line(line), &name));
            }
            Err(_) => {}
        }
        let mut from = 0;
        let mut missing_from = 0;
        while from < words.len() {
            let Some((count, path)) = self.longest_name(line, &words[from..])? else {
                // Options are of no use here, and a name's last word is the one with the ending.
                let last = words[from].to_ascii_lowercase().ends_with(b".mtl") || from + 1 == words.len();
                from += 1;
                if last {
                    let name = lines::text(&words[missing_from..from].join(&b' '));
                    self.warn_missing(line, &name);
                    missing_from = from;
                }
                continue;
            };
            self.read(path)?;
            from += count;
            missing_from = from;
        }
        Ok(())
    }

    fn warn_missing(&self, line: u64, name: &str) {
        let what = format!("line {line}: `{name}` is not there; its materials are painted grey");
        self.reporter.warn("missing-mtl", self.obj, what);
    }

    fn longest_name(&mut self, line: u64, words: &[&[u8]]) -> Result<Option<(usize, PathBuf)>> {
        for count in (1..=words.len().min(NAME_WORDS)).rev() {
            if count > 1 && self.lookups_left == 0 {
                continue;
            }
            self.lookups_left = self.lookups_left.saturating_sub(1);
            match find(&mut self.resolver, folder_of(self.obj), &words[..count].join(&b' ')) {
                Ok(path) => return Ok(Some((count, path))),
                Err((Refusal::Missing, _)) => {}
                Err((refusal, name)) if count == 1 => {
                    return Err(refusal.into_error(self.obj, Place::Line(line), &name));
                }
                Err(_) => {}
            }
        }
        Ok(None)
    }

    fn read(&mut self, path: PathBuf) -> Result<()> {
        if !self.seen.insert(path.clone()) {
            return Ok(());
        }
        let size = std::fs::metadata(&path).map_err(Error::io("read", &path))?.len();
        if size > SIZE_LIMIT_BYTES {
            let what = format!("is {size} bytes; an MTL of up to {SIZE_LIMIT_BYTES} is read");
            return Err(Error::Limit { path, what });
        }
        let bytes = std::fs::read(&path).map_err(Error::io("read", &path))?;
        let file = self.files.len();
        for entry in parse(bytes, &path)? {
            if self.by_name.contains_key(&entry.name) {
                let what = format!("material `{}` is defined more than once; the first is used", entry.name);
                self.reporter.warn("repeated-material", &path, what);
                continue;
            }
            self.by_name.insert(entry.name.clone(), self.entries.len());
            self.entries.push((file, entry));
        }
        self.files.push(path);
        Ok(())
    }

    /// The material called `name`; its image is looked for now and added to `images` unless it is there.
    ///
    /// # Errors
    /// An image path that leaves the folder.
    pub fn material(&mut self, name: &[u8], images: &mut Vec<ImageRef>) -> Result<Material> {
        let name = lines::text(name);
        let Some(&index) = self.by_name.get(&name) else {
            if !self.files.is_empty() && !name.is_empty() {
                let what = format!("material `{name}` is in none of its MTL files; painted grey");
                self.reporter.warn("missing-material", self.obj, what);
            }
            return Ok(Material { name, base_color: DEFAULT_COLOR, image: None });
        };
        let (file, entry) = &self.entries[index];
        let mtl = &self.files[*file];
        let mut material = Material { name, base_color: entry.color, image: None };
        let Some((line, rest)) = &entry.map else { return Ok(material) };
        match find(&mut self.resolver, folder_of(mtl), rest) {
            Ok(path) => {
                let known = self.images.entry(path.clone()).or_insert_with(|| {
                    images.push(ImageRef::File(path));
                    images.len() as u32 - 1
                });
                material.image = Some(*known);
            }
            Err((Refusal::Missing, wanted)) => {
                let what = format!("line {line}: `{wanted}` is not there; material `{}` has no image", material.name);
                self.reporter.warn("missing-texture", mtl, what);
            }
            Err((refusal, wanted)) => return Err(refusal.into_error(mtl, Place::Line((*line).into()), &wanted)),
        }
        Ok(material)
    }
}

fn folder_of(file: &Path) -> &Path {
    file.parent().unwrap_or(Path::new("."))
}

/// The first spelling of a file name that is there; else the first that is refused, else the first.
fn find(resolver: &mut Resolver, base: &Path, rest: &[u8]) -> Result<PathBuf, (Refusal, String)> {
    let mut failed: Option<(Refusal, String)> = None;
    for name in spellings(rest) {
        match resolver.resolve(base, &name) {
            Ok(path) => return Ok(path),
            Err(refusal) => {
                if failed
                    .as_ref()
                    .is_none_or(|(first, _)| matches!(first, Refusal::Missing) && !matches!(refusal, Refusal::Missing))
                {
                    failed = Some((refusal, name));
                }
            }
        }
    }
    Err(failed.unwrap_or((Refusal::Missing, String::new())))
}

/// What a file name may mean: without a comment, as it stands, without options behind it; quotes and `\ ` resolved.
fn spellings(rest: &[u8]) -> Vec<String> {
    let whole = trim(rest);
    let options = whole.windows(2).position(|pair| lines::is_space(pair[0]) && pair[1] == b'-');
    let mut found: Vec<String> = Vec::new();
    for name in [without_comment(whole), whole, trim(&whole[..options.unwrap_or(whole.len())])] {
        let name = lines::text(name).replace("\\ ", " ");
        let name = name.strip_prefix('"').and_then(|n| n.strip_suffix('"')).unwrap_or(&name).to_owned();
        if !name.is_empty() && !found.contains(&name) {
            found.push(name);
        }
    }
    found
}

/// The materials of an MTL file, in its order.
fn parse(bytes: Vec<u8>, path: &Path) -> Result<Vec<Entry>> {
    let bytes = lines::decoded(bytes);
    if let Some(nul) = memchr::memchr(0, &bytes) {
        let what = "holds a NUL byte, so it is not MTL text; mend it or remove the mtllib line";
        return Err(Error::input_at(path, Place::Byte(nul as u64), what));
    }
    let mut entries: Vec<Entry> = Vec::new();
    let lines = lines::for_each_line(&bytes, |number, line| {
        let (word, rest) = split_word(line);
        if word.eq_ignore_ascii_case(b"newmtl") {
            let name = lines::text(without_comment(trim(rest)));
            entries.push(Entry { name, color: DEFAULT_COLOR, map: None });
        }
        let Some(entry) = entries.last_mut() else { return };
        if word.eq_ignore_ascii_case(b"Kd") {
            entry.color = color(rest);
        } else if word.eq_ignore_ascii_case(b"map_Kd") {
            let file = trim(without_options(rest));
            entry.map = (!file.is_empty()).then(|| (number, file.to_vec()));
        }
    });
    match lines {
        Ok(_) => Ok(entries),
        Err(at) => {
            let what = format!("the line at byte {at} is longer than {} bytes, the limit", lines::LINE_LIMIT_BYTES);
            Err(Error::Limit { path: path.to_path_buf(), what })
        }
    }
}

/// `r g b` or one grey; anything else (`spectral`, `xyz`, what is no number) is the default.
fn color(rest: &[u8]) -> [u8; 3] {
    let values: Vec<f64> = Numbers(rest).take(4).collect();
    if values.iter().any(|v| !v.is_finite()) {
        return DEFAULT_COLOR;
    }
    let byte = |value: f64| (value.clamp(0.0, 1.0) * 255.0).round() as u8;
    match values[..] {
        [grey] => [byte(grey); 3],
        [red, green, blue] => [byte(red), byte(green), byte(blue)],
        _ => DEFAULT_COLOR,
    }
}

/// What follows the options of a `map_Kd`: the file name.
fn without_options(rest: &[u8]) -> &[u8] {
    let mut rest = trim(rest);
    while let (option, mut after) = split_word(rest)
        && let Some((arguments, numeric)) = arguments(option)
    {
        for _ in 0..arguments {
            let (word, next) = split_word(after);
            // Optional numbers end where the file name begins; the last word is the file name in any case.
            if next.is_empty() || (numeric && !Numbers(word).all(f64::is_finite)) {
                break;
            }
            after = next;
        }
        rest = after;
    }
    rest
}

/// How many arguments an option takes at most, and whether they are numbers.
fn arguments(option: &[u8]) -> Option<(usize, bool)> {
    Some(match option.to_ascii_lowercase().as_slice() {
        b"-s" | b"-o" | b"-t" => (3, true),
        b"-mm" => (2, true),
        b"-bm" | b"-boost" | b"-texres" => (1, true),
        b"-blendu" | b"-blendv" | b"-cc" | b"-clamp" | b"-imfchan" | b"-type" | b"-colorspace" => (1, false),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Vec<Entry> {
        parse(text.as_bytes().to_vec(), Path::new("x.mtl")).unwrap()
    }

    fn map(rest: &str) -> String {
        let entries = parsed(&format!("newmtl m\nmap_Kd {rest}\n"));
        entries[0].map.as_ref().map_or(String::new(), |(_, rest)| lines::text(rest))
    }

    #[test]
    fn colours_of_one_or_three_numbers_are_read_and_the_rest_is_grey() {
        for (kd, expected) in [
            ("1 0 0.5", [255, 0, 128]),
            ("0.5", [128; 3]),
            ("2 -1 1 # bright", [255, 0, 255]),
            ("0.1 0.2", DEFAULT_COLOR),
            ("spectral file.rfl 1", DEFAULT_COLOR),
            ("xyz 1 1 1", DEFAULT_COLOR),
            ("1 nan 1", DEFAULT_COLOR),
            ("1 1,0 1", DEFAULT_COLOR),
            ("", DEFAULT_COLOR),
        ] {
            assert_eq!(parsed(&format!("newmtl m\nKd {kd}\n"))[0].color, expected, "Kd {kd}");
        }
    }

    #[test]
    fn map_options_are_skipped_with_their_arguments() {
        for rest in [
            "a b.jpg",
            "-s 1 2 3 -o 0.1 a b.jpg",
            "-clamp on -bm 0.5 -mm 0 1 a b.jpg",
            "-blendu on -blendv off -cc on -texres 512 -type sphere -imfchan r -boost 2 -colorspace sRGB a b.jpg",
            "\t-t 1 1\t-O 1 1 1   a b.jpg  ",
        ] {
            assert_eq!(map(rest), "a b.jpg", "{rest}");
        }
        assert_eq!(map("-s 1 2 3.jpg"), "3.jpg");
        assert_eq!(map("-s 1 2"), "2");
        assert_eq!(map("-odd.jpg"), "-odd.jpg");
        assert_eq!(map(""), "");
        assert_eq!(map("-s"), "");
    }

    #[test]
    fn a_file_name_is_tried_in_every_sensible_spelling() {
        assert_eq!(spellings(b"a.jpg # roof"), ["a.jpg", "a.jpg # roof"]);
        assert_eq!(spellings(b"a.jpg -bm 2"), ["a.jpg -bm 2", "a.jpg"]);
        assert_eq!(spellings(b"\"my file.jpg\""), ["my file.jpg"]);
        assert_eq!(spellings(b"my\\ file.jpg"), ["my file.jpg"]);
    }

    #[test]
    fn lines_before_the_first_newmtl_are_skipped_and_names_keep_their_spaces() {
        let entries = parsed("Kd 1 1 1\nmap_Kd x.jpg\n  newmtl\t roof tile 1 \nNEWMTL #2\n");
        assert_eq!(entries.iter().map(|e| e.name.as_str()).collect::<Vec<_>>(), ["roof tile 1", "#2"]);
        assert!(entries.iter().all(|e| e.map.is_none() && e.color == DEFAULT_COLOR));
    }

    #[test]
    fn bytes_that_are_no_text_and_endless_lines_are_refused() {
        assert!(matches!(parse(b"newmtl \0".to_vec(), Path::new("x")), Err(Error::Input { .. })));
        let long = vec![b'a'; lines::LINE_LIMIT_BYTES + 1];
        assert!(matches!(parse(long, Path::new("x")), Err(Error::Limit { .. })));
    }
}
