//! The rows of a PLY body as numbers, the same for text and both byte orders.

use super::header::{Element, Kind, Type, split_line};
use crate::error::Place;

/// Why a row cannot be read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Broken {
    /// The file ends.
    FileEnds,
    /// The line has too few values.
    LineEnds,
    /// A value is not a number.
    NotANumber,
    /// A list with a negative or broken length.
    Length(f64),
    /// A face that names a vertex that is not there.
    Index(f64),
}

/// A cursor over rows. Cloning it marks a place to come back to.
pub trait Body: Clone {
    /// Goes to the next row.
    fn begin_row(&mut self) -> Result<(), Broken>;
    /// The next value of the row, stored as `kind`.
    fn number(&mut self, kind: Type) -> Result<f64, Broken>;
    /// Passes over `count` values stored as `kind`.
    fn skip(&mut self, kind: Type, count: u64) -> Result<(), Broken>;
    /// Passes over a whole element.
    fn skip_element(&mut self, element: &Element) -> Result<(), Broken>;
    /// Bytes not read yet.
    fn left(&self) -> u64;
    /// Where the cursor is, for messages.
    fn place(&self) -> Place;

    /// The length of a list.
    fn length(&mut self, kind: Type) -> Result<u64, Broken> {
        let length = self.number(kind)?;
        if length >= 0.0 && length.fract() == 0.0 { Ok(length as u64) } else { Err(Broken::Length(length)) }
    }
}

/// A binary body.
#[derive(Clone)]
pub struct Binary<'a, const BIG: bool> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a, const BIG: bool> Binary<'a, BIG> {
    /// Starts at byte `at` of the file.
    pub fn new(bytes: &'a [u8], at: usize) -> Self {
        Self { bytes, at }
    }

    /// The next `N` bytes, little end first.
    fn take<const N: usize>(&mut self) -> Result<[u8; N], Broken> {
        let mut taken = *self.bytes[self.at..].first_chunk::<N>().ok_or(Broken::FileEnds)?;
        self.at += N;
        if BIG {
            taken.reverse();
        }
        Ok(taken)
    }
}

impl<const BIG: bool> Body for Binary<'_, BIG> {
    fn begin_row(&mut self) -> Result<(), Broken> {
        Ok(())
    }

    #[inline]
    fn number(&mut self, kind: Type) -> Result<f64, Broken> {
        Ok(match kind {
            Type::U8 => f64::from(self.take::<1>()?[0]),
            Type::I8 => f64::from(i8::from_le_bytes(self.take()?)),
            Type::I32 => f64::from(i32::from_le_bytes(self.take()?)),
            Type::U32 => f64::from(u32::from_le_bytes(self.take()?)),
            Type::F32 => f64::from(f32::from_le_bytes(self.take()?)),
            Type::F64 => f64::from_le_bytes(self.take()?),
            Type::I16 => f64::from(i16::from_le_bytes(self.take()?)),
            Type::U16 => f64::from(u16::from_le_bytes(self.take()?)),
            Type::I64 => i64::from_le_bytes(self.take()?) as f64,
            Type::U64 => u64::from_le_bytes(self.take()?) as f64,
        })
    }

    fn skip(&mut self, kind: Type, count: u64) -> Result<(), Broken> {
        let bytes = kind.bytes().checked_mul(count).filter(|&bytes| bytes <= self.left());
        self.at += bytes.ok_or(Broken::FileEnds)? as usize;
        Ok(())
    }

    fn skip_element(&mut self, element: &Element) -> Result<(), Broken> {
        if let Some(row_bytes) = element.row_bytes() {
            return self.skip(Type::U8, row_bytes.checked_mul(element.count).ok_or(Broken::FileEnds)?);
        }
        for _ in 0..element.count {
            for property in &element.properties {
                match property.kind {
                    Kind::Scalar(kind) => self.skip(kind, 1)?,
                    Kind::List { length, item } => {
                        let length = self.length(length)?;
                        self.skip(item, length)?;
                    }
                }
            }
        }
        Ok(())
    }

    fn left(&self) -> u64 {
        (self.bytes.len() - self.at) as u64
    }

    fn place(&self) -> Place {
        Place::Byte(self.at as u64)
    }
}

/// A text body: a row a line.
#[derive(Clone)]
pub struct Ascii<'a> {
    rest: &'a [u8],
    line: &'a [u8],
    line_number: u64,
    is_cr: bool,
}

impl<'a> Ascii<'a> {
    /// Starts with `rest`, after `lines` lines of header.
    pub fn new(rest: &'a [u8], lines: u64, is_cr: bool) -> Self {
        Self { rest, line: &[], line_number: lines, is_cr }
    }
}

impl Body for Ascii<'_> {
    fn begin_row(&mut self) -> Result<(), Broken> {
        loop {
            if self.rest.is_empty() {
                return Err(Broken::FileEnds);
            }
            (self.line, self.rest) = split_line(self.rest, self.is_cr).unwrap_or((self.rest, &[]));
            self.line_number += 1;
            self.line = self.line.trim_ascii_start();
            if !self.line.is_empty() {
                return Ok(());
            }
        }
    }

    fn number(&mut self, _: Type) -> Result<f64, Broken> {
        let line = self.line.trim_ascii_start();
        if line.is_empty() {
            return Err(Broken::LineEnds);
        }
        let (value, length) = fast_float2::parse_partial::<f64, _>(line).map_err(|_| Broken::NotANumber)?;
        self.line = &line[length..];
        match self.line.first() {
            Some(next) if !next.is_ascii_whitespace() => Err(Broken::NotANumber),
            _ => Ok(value),
        }
    }

    fn skip(&mut self, kind: Type, count: u64) -> Result<(), Broken> {
        // Ends with the line at the latest, whatever the count.
        (0..count).try_for_each(|_| self.number(kind).map(drop))
    }

    fn skip_element(&mut self, element: &Element) -> Result<(), Broken> {
        if element.properties.is_empty() {
            return Ok(());
        }
        (0..element.count).try_for_each(|_| self.begin_row())
    }

    fn left(&self) -> u64 {
        (self.rest.len() + self.line.len()) as u64
    }

    fn place(&self) -> Place {
        Place::Line(self.line_number)
    }
}
