//! Subtree files of implicit tiling: which tiles, contents and child subtrees there are.

use super::json::{Availability, OneOrMany, Subtree as Wire};
use super::refusal::{Refusal, refuse};
use super::store::{Address, Stores};

const HEADER_BYTES: usize = 24;

/// What a subtree says to be there.
pub struct Subtree {
    /// By Morton index, level after level.
    pub tiles: Bits,
    /// The same, for each content.
    pub contents: Vec<Bits>,
    /// By Morton index in the level below the last.
    pub children: Bits,
    /// It holds metadata of its tiles, which are not read.
    pub has_metadata: bool,
    /// Size of its JSON and buffers.
    pub bytes: u64,
}

/// An availability bitstream.
#[derive(Debug, PartialEq, Eq)]
pub enum Bits {
    /// All or none.
    Constant(bool),
    /// Lowest bit first.
    Stream(Vec<u8>),
}

impl Bits {
    /// Bit `i`; false beyond the end.
    pub fn at(&self, i: u64) -> bool {
        match self {
            Self::Constant(all) => *all,
            Self::Stream(bytes) => usize::try_from(i / 8)
                .ok()
                .and_then(|byte| bytes.get(byte))
                .is_some_and(|byte| byte >> (i % 8) & 1 == 1),
        }
    }
}

impl Subtree {
    /// Reads the subtree at `at` of `nodes` tiles, with `leaves` places for child subtrees.
    pub fn read(stores: &Stores, at: &Address, nodes: u64, leaves: u64) -> Result<Self, Refusal> {
        let bytes = stores.fetch(at)?.bytes;
        let (json, binary) = split(&bytes)?;
        let wire: Wire = serde_json::from_slice(json)
            .map_err(|e| Refusal::new("broken-subtree", format!("{}: its JSON is no subtree: {e}", at.path)))?;
        let mut parts = Parts { stores, at, wire: &wire, binary, bytes: bytes.len() as u64 };
        let Some(tiles) = &wire.tile_availability else {
            return refuse("broken-subtree", format!("{} has no tileAvailability", at.path));
        };
        let tiles = parts.bits(tiles, nodes)?;
        let children = match &wire.child_subtree_availability {
            Some(children) => parts.bits(children, leaves)?,
            None => Bits::Constant(false),
        };
        let multiple =
            wire.extensions.as_ref().and_then(|e| e.multiple_contents.as_ref()?.content_availability.as_ref());
        let contents: &[Availability] = match wire.content_availability.as_ref().or(multiple) {
            Some(OneOrMany::One(one)) => std::slice::from_ref(one),
            Some(OneOrMany::Many(many)) => many,
            None => &[],
        };
        let contents = contents.iter().map(|content| parts.bits(content, nodes)).collect::<Result<_, _>>()?;
        Ok(Self { tiles, contents, children, has_metadata: wire.tile_metadata.is_some(), bytes: parts.bytes })
    }
}

fn split(bytes: &[u8]) -> Result<(&[u8], &[u8]), Refusal> {
    if !bytes.starts_with(b"subt") {
        return Ok((bytes, &[]));
    }
    let size = |at: usize| bytes.get(at..at + 8).and_then(|b| b.try_into().ok()).map(u64::from_le_bytes);
    let broken = || Refusal::new("broken-subtree", format!("a subtree of {} bytes is cut short", bytes.len()));
    let part = |from: usize, length: u64| {
        let end = usize::try_from(length).ok().and_then(|length| from.checked_add(length)).ok_or_else(broken)?;
        bytes.get(from..end).ok_or_else(broken)
    };
    let json = part(HEADER_BYTES, size(8).ok_or_else(broken)?)?;
    let binary = part(HEADER_BYTES + json.len(), size(16).ok_or_else(broken)?)?;
    let end = json.iter().rposition(|&b| b != 0 && !b.is_ascii_whitespace()).map_or(0, |last| last + 1);
    Ok((&json[..end], binary))
}

struct Parts<'a> {
    stores: &'a Stores,
    at: &'a Address,
    wire: &'a Wire,
    binary: &'a [u8],
    bytes: u64,
}

impl Parts<'_> {
    fn bits(&mut self, availability: &Availability, count: u64) -> Result<Bits, Refusal> {
        let Some(index) = availability.bitstream else {
            return match availability.constant {
                Some(constant) => Ok(Bits::Constant(constant != 0)),
                None => refuse("broken-subtree", "an availability has neither constant nor bitstream"),
            };
        };
        let broken = |what: String| Refusal::new("broken-subtree", what);
        let at = |index: u64| usize::try_from(index).unwrap_or(usize::MAX);
        let view = self.wire.buffer_views.as_ref().and_then(|views| views.get(at(index)));
        let view = view.ok_or_else(|| broken(format!("there is no bufferView {index}")))?;
        let buffer = view.buffer.ok_or_else(|| broken(format!("bufferView {index} names no buffer")))?;
        let wire = self.wire.buffers.as_ref().and_then(|buffers| buffers.get(at(buffer)));
        let wire = wire.ok_or_else(|| broken(format!("there is no buffer {buffer}")))?;
        let fetched;
        let bytes = match &wire.uri {
            None => self.binary,
            Some(uri) => {
                fetched = self.stores.fetch(&self.stores.resolve(self.at, uri)?)?.bytes;
                self.bytes += fetched.len() as u64;
                &fetched
            }
        };
        let offset = view.byte_offset.unwrap_or(0);
        let length = view.byte_length.unwrap_or(0);
        let found = offset.checked_add(length).and_then(|end| bytes.get(at(offset)..at(end)));
        let found = found.ok_or_else(|| broken(format!("bufferView {index} leaves its buffer of {}", bytes.len())))?;
        if (found.len() as u64).saturating_mul(8) < count {
            return refuse("broken-subtree", format!("bufferView {index} has {} bytes for {count} bits", found.len()));
        }
        Ok(Bits::Stream(found.to_vec()))
    }
}
