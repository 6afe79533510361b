//! The header of a PLY file: format, elements, properties, texture names.

use std::path::Path;

use crate::error::Place;
use crate::report::Reporter;
use crate::{Error, Result};

/// A header is a few hundred bytes; this leaves room for long comments and bounds the search for its end.
const MAX_HEADER_BYTES: usize = 1 << 20;

/// How the body is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// A scalar type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Type {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Type {
    fn of(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "int64" | "longlong" => Self::I64,
            "uint64" | "ulonglong" => Self::U64,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes in a binary body.
    pub fn bytes(self) -> u64 {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// True for floating-point types.
    pub fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }
}

/// What a property holds in each row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Scalar(Type),
    List { length: Type, item: Type },
}

/// A named column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Property {
    pub name: String,
    pub kind: Kind,
}

/// A named table. `count` is the file's word: nothing is allocated by it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
}

impl Element {
    /// The type of scalar property `name`.
    pub fn scalar(&self, name: &str) -> Option<Type> {
        self.properties.iter().find_map(|p| match p.kind {
            Kind::Scalar(kind) if p.name == name => Some(kind),
            _ => None,
        })
    }

    /// Bytes of a row in a binary body if it has no lists.
    pub fn row_bytes(&self) -> Option<u64> {
        let bytes = |p: &Property| match p.kind {
            Kind::Scalar(kind) => Some(kind.bytes()),
            Kind::List { .. } => None,
        };
        self.properties.iter().map(bytes).sum()
    }
}

/// A parsed header and where the body begins.
#[derive(Debug)]
pub struct Header {
    pub format: Format,
    pub elements: Vec<Element>,
    /// `comment TextureFile`, in order.
    pub textures: Vec<String>,
    /// Offset of the body.
    pub body_at: usize,
    /// Lines of the header.
    pub lines: u64,
    /// Lines end in a lone CR, as on old Macintoshes.
    pub is_cr: bool,
}

/// The bytes of the first line and those after it.
pub fn split_line(bytes: &[u8], is_cr: bool) -> Option<(&[u8], &[u8])> {
    let end = memchr::memchr(if is_cr { b'\r' } else { b'\n' }, bytes)?;
    Some((&bytes[..end], &bytes[end + 1..]))
}

/// Parses the header at the start of `bytes`.
pub fn parse(path: &Path, bytes: &[u8], reporter: &Reporter) -> Result<Header> {
    let after_magic = bytes.strip_prefix(b"ply").filter(|rest| rest.first().is_some_and(u8::is_ascii_whitespace));
    let after_magic = after_magic.ok_or_else(|| Error::input(path, "does not start with a line 'ply'"))?;
    let is_cr = after_magic.first() == Some(&b'\r') && after_magic.get(1) != Some(&b'\n');
    let mut rest = &bytes[..bytes.len().min(MAX_HEADER_BYTES)];
    let mut reading = Reading::default();
    for line_number in 1.. {
        let Some((line, after)) = split_line(rest, is_cr) else { break };
        rest = after;
        let line = String::from_utf8_lossy(line);
        let line = line.trim();
        if line == "end_header" {
            let body_at = bytes.len().min(MAX_HEADER_BYTES) - rest.len();
            return reading.finish(path, body_at, line_number, is_cr);
        }
        let refuse = |what: String| Error::input_at(path, Place::Line(line_number), what);
        if !reading.line(line, line_number == 1).map_err(refuse)? {
            reporter.warn("ply-header-line", path, format!("line {line_number} of the header is not understood"));
        }
    }
    Err(Error::input(path, format!("no 'end_header' in the first {} bytes", bytes.len().min(MAX_HEADER_BYTES))))
}

#[derive(Default)]
struct Reading {
    format: Option<Format>,
    elements: Vec<Element>,
    textures: Vec<String>,
}

impl Reading {
    /// Takes a line in; false if it is none of the known ones, an error if it is a broken known one.
    fn line(&mut self, line: &str, is_first: bool) -> Result<bool, String> {
        let (keyword, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        let words: Vec<&str> = rest.split_whitespace().collect();
        match (keyword, &words[..]) {
            ("ply", []) => return Ok(is_first),
            ("", _) | ("obj_info", _) => {}
            ("format", [format, "1.0"]) => {
                self.format = Some(match *format {
                    "ascii" => Format::Ascii,
                    "binary_little_endian" => Format::LittleEndian,
                    "binary_big_endian" => Format::BigEndian,
                    other => {
                        return Err(format!(
                            "format {other:?}, wanted ascii, binary_little_endian or binary_big_endian"
                        ));
                    }
                });
            }
            ("comment", [tag, _, ..]) if tag.eq_ignore_ascii_case("TextureFile") => {
                self.textures.push(rest.trim_start()[tag.len()..].trim().to_owned());
            }
            ("comment", _) => {}
            ("element", [name, count]) => {
                let count =
                    count.parse().map_err(|_| format!("element {name} has count {count:?}, wanted a number"))?;
                if self.elements.iter().any(|e| e.name == *name) {
                    return Err(format!("a second element {name:?}"));
                }
                self.elements.push(Element { name: (*name).into(), count, properties: Vec::new() });
            }
            ("property", ["list", length, item, name]) => {
                let length = scalar_type(length)?;
                if length.is_float() {
                    return Err(format!("list {name:?} has a floating-point length"));
                }
                self.property(name, Kind::List { length, item: scalar_type(item)? })?;
            }
            ("property", [kind, name]) => self.property(name, Kind::Scalar(scalar_type(kind)?))?,
            ("format" | "element" | "property", _) => return Err(format!("broken {keyword} line")),
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn property(&mut self, name: &str, kind: Kind) -> Result<(), String> {
        let element = self.elements.last_mut().ok_or_else(|| format!("property {name:?} before any element"))?;
        element.properties.push(Property { name: name.to_ascii_lowercase(), kind });
        Ok(())
    }

    fn finish(self, path: &Path, body_at: usize, lines: u64, is_cr: bool) -> Result<Header> {
        let format = self.format.ok_or_else(|| Error::input(path, "the header has no 'format' line"))?;
        Ok(Header { format, elements: self.elements, textures: self.textures, body_at, lines, is_cr })
    }
}

fn scalar_type(name: &str) -> Result<Type, String> {
    Type::of(name).ok_or_else(|| format!("type {name:?} is not a PLY type"))
}
