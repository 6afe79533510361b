//! Reads where a model lies from the files photogrammetry programs put beside it.
//!
//! In: `metadata.xml` (ContextCapture, iTwin Capture, DJI Terra) or ODM's `coords.txt`,
//! `odm_georeferencing_model_geo.txt`. Out: [`Georeference`].
//!
//! # Promises
//! No more than 1 MiB of a file is read. An error names the file and is one sentence.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use glam::DVec3;

use crate::error::Place;
use crate::geo::crs::shortened;
use crate::geo::georeference::{Georeference, numbers, parse_origin};
use crate::{Error, Result};

/// The largest part of a file that is looked at, bytes. Real ones hold their origin in the first kilobyte.
const MOST_BYTES: u64 = 1 << 20;
/// XML nodes a metadata file may have. Real ones have about a dozen.
const MOST_NODES: u32 = 10_000;

/// Reads a `metadata.xml`: `<SRS>` and `<SRSOrigin>` under `<ModelMetadata>`.
///
/// A vertex means `vertex + SRSOrigin` in the SRS. A missing or empty `<SRS>` and `local` mean a local system.
///
/// # Errors
/// [`Error::Input`] for broken or contradictory files, [`Error::Limit`] for ones over 1 MiB.
pub fn read_metadata_xml(path: &Path) -> Result<Georeference> {
    let (text, whole) = read_head(path)?;
    if !whole {
        let what =
            format!("is larger than {MOST_BYTES} bytes, which no model's metadata is; wanted a ModelMetadata file");
        return Err(Error::Limit { path: path.to_path_buf(), what });
    }
    let options =
        roxmltree::ParsingOptions { allow_dtd: false, nodes_limit: MOST_NODES, ..roxmltree::ParsingOptions::default() };
    let document = roxmltree::Document::parse_with_options(&text, options)
        .map_err(|why| Error::input_at(path, Place::Line(why.pos().row.into()), format!("is not sound XML: {why}")))?;
    let root = document.root_element();
    if root.tag_name().name() != "ModelMetadata" {
        let found = shortened(root.tag_name().name());
        return Err(Error::input(
            path,
            format!("found <{found}>, wanted <ModelMetadata>; give --crs and --origin instead"),
        ));
    }
    let srs = only_child(path, root, "SRS")?;
    let origin = only_child(path, root, "SRSOrigin")?;
    let Some((srs, line)) = srs.filter(|(text, _)| !text.is_empty()) else { return Ok(Georeference::Local) };
    let georeference = Georeference::parse(&srs).map_err(|why| at_line(path, line, "<SRS>", why))?;
    match origin.filter(|(text, _)| !text.is_empty()) {
        Some((text, line)) => {
            let origin = parse_origin(&text).map_err(|why| at_line(path, line, "<SRSOrigin>", why))?;
            Ok(georeference.with_origin(origin))
        }
        None => Ok(georeference),
    }
}

/// Reads ODM's `coords.txt` or `odm_georeferencing_model_geo.txt`: a system, then `east north`.
///
/// A vertex means E = x + east, N = y + north; its z is absolute. A byte-order mark, CRLF, blank lines and lines that
/// begin with `#` are tolerated; what follows (camera positions) is not looked at.
///
/// # Errors
/// [`Error::Input`] naming the line.
pub fn read_odm(path: &Path) -> Result<Georeference> {
    let (text, _) = read_head(path)?;
    let mut lines = (1u64..)
        .zip(text.lines())
        .map(|(number, line)| (number, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let missing = |what: &str| Error::input(path, format!("it ends before {what}"));
    let (line, system) = lines.next().ok_or_else(|| missing("the coordinate system, wanted on line 1"))?;
    let georeference = Georeference::parse(system).map_err(|why| at_line(path, line, "coordinate system", why))?;
    if !matches!(georeference, Georeference::Projected { .. }) {
        let what = format!("found '{}', wanted a projected system such as WGS84 UTM 32N", shortened(system));
        return Err(Error::input_at(path, Place::Line(line), what));
    }
    let (line, offset) = lines.next().ok_or_else(|| missing("'east north', wanted on line 2"))?;
    match numbers(offset).as_deref() {
        // More than two would be a camera position: the offset is missing.
        Ok([east, north]) => Ok(georeference.with_origin(DVec3::new(*east, *north, 0.0))),
        _ => {
            let what = format!("found '{}', wanted two numbers: east north", shortened(offset));
            Err(Error::input_at(path, Place::Line(line), what))
        }
    }
}

/// The beginning of a text file without its byte-order mark, and whether that was all of it.
fn read_head(path: &Path) -> Result<(String, bool)> {
    let file = File::open(path).map_err(Error::io("read", path))?;
    let mut bytes = Vec::new();
    file.take(MOST_BYTES + 1).read_to_end(&mut bytes).map_err(Error::io("read", path))?;
    let whole = bytes.len() as u64 <= MOST_BYTES;
    bytes.truncate(MOST_BYTES as usize);
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(Error::input(path, "is UTF-16, wanted UTF-8; save it as UTF-8"));
    }
    // Names in other encodings may stand in comments; what is read here is ASCII.
    let text = String::from_utf8_lossy(&bytes);
    Ok((text.trim_start_matches('\u{feff}').to_owned(), whole))
}

/// The text and line of the one child called `name`.
fn only_child(path: &Path, root: roxmltree::Node<'_, '_>, name: &str) -> Result<Option<(String, u64)>> {
    let mut found = root.children().filter(|node| node.tag_name().name() == name);
    let Some(first) = found.next() else { return Ok(None) };
    let line = |node: roxmltree::Node<'_, '_>| u64::from(root.document().text_pos_at(node.range().start).row);
    if let Some(second) = found.next() {
        let what =
            format!("found <{name}> a second time (first on line {}), wanted one; delete the wrong one", line(first));
        return Err(Error::input_at(path, Place::Line(line(second)), what));
    }
    // Comments inside the element split its text.
    let text: String = first.children().filter_map(|node| node.text().filter(|_| node.is_text())).collect();
    Ok(Some((text.trim().to_owned(), line(first))))
}

/// Puts the file's place on a complaint about its text.
fn at_line(path: &Path, line: u64, what: &str, why: Error) -> Error {
    match why {
        Error::Config(why) => Error::input_at(path, Place::Line(line), format!("{what}: {why}")),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geo::Vertical;

    fn written(text: &[u8]) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    fn metadata(inner: &str) -> Result<Georeference> {
        let text = format!(
            "\u{feff}<?xml version=\"1.0\" encoding=\"utf-8\"?>\r\n<ModelMetadata version=\"1\">\r\n{inner}\r\n\
             <Texture><ColorSource>Visible</ColorSource></Texture></ModelMetadata>"
        );
        read_metadata_xml(written(text.as_bytes()).path())
    }

    fn origin_of(georeference: &Georeference) -> (Option<u32>, DVec3) {
        match georeference {
            Georeference::Projected { crs, origin, vertical: Vertical::Ellipsoidal } => (crs.epsg(), *origin),
            other => panic!("wanted a projected georeference, found {other:?}"),
        }
    }

    #[test]
    fn metadata_with_a_code_and_an_origin_is_read() {
        let read = metadata("<SRS>EPSG:5186</SRS><SRSOrigin>282345,530506,0</SRSOrigin>").unwrap();
        assert_eq!(origin_of(&read), (Some(5186), DVec3::new(282_345.0, 530_506.0, 0.0)));
        let read = metadata(
            "<SRS> epsg:25832+5783\n</SRS><!-- x -->\n<SRSOrigin> 671842.3164090217 , 5336500.25 </SRSOrigin>",
        );
        let read = read.unwrap();
        assert_eq!(origin_of(&read), (Some(25832), DVec3::new(671_842.316_409_021_7, 5_336_500.25, 0.0)));
        assert!(matches!(&read, Georeference::Projected { crs, .. } if crs.vertical() == Some("EPSG:5783")));
    }

    #[test]
    fn metadata_in_wkt_is_read_with_its_entities() {
        let wkt = "PROJCS[&quot;ETRS89 / UTM zone 32N&quot;,AUTHORITY[&quot;EPSG&quot;,&quot;25832&quot;]]";
        let read = metadata(&format!("<SRS>{wkt}</SRS><SRSOrigin>500000,5400000,10</SRSOrigin>")).unwrap();
        assert_eq!(origin_of(&read), (Some(25832), DVec3::new(500_000.0, 5_400_000.0, 10.0)));
    }

    #[test]
    fn metadata_in_enu_takes_the_latitude_first_and_its_origin_as_an_offset() {
        let read = metadata("<SRS>ENU:48.14,11.58</SRS><SRSOrigin>10,-20,30</SRSOrigin>").unwrap();
        let offset = DVec3::new(10.0, -20.0, 30.0);
        assert_eq!(read, Georeference::Enu { lat_deg: 48.14, lon_deg: 11.58, height_m: 0.0, offset });
    }

    #[test]
    fn metadata_without_a_system_is_local() {
        assert_eq!(metadata("").unwrap(), Georeference::Local);
        assert_eq!(metadata("<SRS/><SRSOrigin>1,2,3</SRSOrigin>").unwrap(), Georeference::Local);
        assert_eq!(metadata("<SRS>Local</SRS><SRSOrigin>0,0,0</SRSOrigin>").unwrap(), Georeference::Local);
    }

    #[test]
    fn broken_metadata_is_refused_with_the_reason() {
        let cases = [
            ("<SRS>EPSG:99999</SRS>", "line 3: <SRS>: EPSG:99999 is not a horizontal system known here"),
            ("<SRS>EPSG:x</SRS>", "wanted EPSG:n"),
            ("<SRS>ENU:148.1,-33.5</SRS>", "look swapped"),
            ("<SRS>EPSG:25832</SRS><SRSOrigin>1;x;3</SRSOrigin>", "'x' is not a number"),
            ("<SRS>EPSG:25832</SRS><SRSOrigin>1,2,3,4</SRSOrigin>", "found 4 numbers"),
            ("<SRS>EPSG:25832</SRS><SRSOrigin>NaN,1</SRSOrigin>", "'NaN' is not a number"),
            ("<SRS>EPSG:25832</SRS>\n<SRS>local</SRS>", "line 4: found <SRS> a second time"),
            ("<SRS>EPSG:25832", "is not sound XML"),
        ];
        for (inner, wanted) in cases {
            let found = metadata(inner).unwrap_err();
            assert_eq!(found.exit_code(), 3);
            assert!(found.to_string().contains(wanted), "{inner}: {found}");
        }
    }

    #[test]
    fn foreign_oversized_and_hostile_files_are_refused() {
        let refused = |text: &[u8]| read_metadata_xml(written(text).path()).unwrap_err();
        assert!(refused(b"<metadata/>").to_string().contains("found <metadata>"));
        assert_eq!(refused(&vec![b' '; MOST_BYTES as usize + 1]).exit_code(), 4);
        let bomb = b"<!DOCTYPE a [<!ENTITY b \"bbbb\">]><ModelMetadata><SRS>&b;</SRS></ModelMetadata>";
        assert!(refused(bomb).to_string().contains("DTD"), "{}", refused(bomb));
        assert!(refused(b"\xff\xfe<\0").to_string().contains("UTF-16"));
        let absent = read_metadata_xml(Path::new("/nowhere/metadata.xml")).unwrap_err();
        assert_eq!(absent.exit_code(), 3);
    }

    #[test]
    fn odm_files_are_read_in_all_their_dialects() {
        let zone = |text: &str| origin_of(&read_odm(written(text.as_bytes()).path()).unwrap());
        let origin = DVec3::new(322_000.0, 5_157_000.0, 0.0);
        assert_eq!(zone("WGS84 UTM 32N\n322000 5157000\n1.5 2.5 300\n"), (Some(32632), origin));
        assert_eq!(zone("\u{feff}# made by hand\r\nEPSG:32632\r\n\r\n322000 5157000\r\n"), (Some(32632), origin));
        assert_eq!(zone("WGS84 UTM 18S\n322000 5157000"), (Some(32718), origin));
        let proj = "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs +type=crs\n322000.0\t5157000.0\n";
        assert_eq!(zone(proj), (None, origin));
    }

    #[test]
    fn broken_odm_files_are_refused_with_the_line() {
        let cases = [
            ("", "ends before the coordinate system"),
            ("WGS84 UTM 61N\n1 2", "line 1: coordinate system: 'WGS84 UTM 61N'"),
            ("WGS84 UTM 32N\n", "ends before 'east north'"),
            ("WGS84 UTM 32N\n1.0 2.0 3.0\n", "line 2: found '1.0 2.0 3.0'"),
            ("local\n1 2", "wanted a projected system"),
        ];
        for (text, wanted) in cases {
            let found = read_odm(written(text.as_bytes()).path()).unwrap_err().to_string();
            assert!(found.contains(wanted), "{text:?}: {found}");
        }
    }
}
