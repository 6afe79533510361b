//! Reads a file for an answer, in pieces and on blocking threads.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;
use std::pin::Pin;
use std::sync::Mutex;
use std::task::{Context, Poll, ready};

use axum::body::Bytes;
use hyper::body::{Body, Frame, SizeHint};
use tokio::task::JoinHandle;

use super::index::{self, Stamp};

/// Bytes read, and so held in memory, for one connection at a time. Most tiles come in a few pieces.
const PIECE_BYTES: u64 = 256 << 10;

/// An open file with the tag of its content.
pub(super) struct Opened {
    pub(super) file: File,
    pub(super) bytes: u64,
    pub(super) etag: String,
    /// The content is a gzip stream, as some tilers store their tiles.
    pub(super) is_gzip: bool,
}

/// Opens a file of the table; blocks.
///
/// `known` holds the tag of the last version seen. Nothing is returned for what is no longer the plain file
/// that was indexed, a link above all.
///
/// # Errors
/// Whatever the system says.
pub(super) fn open(path: &Path, known: &Mutex<Option<(Stamp, String)>>) -> io::Result<Option<Opened>> {
    // The table holds paths without links; a folder or file that became one since differs here.
    if path.canonicalize()? != path || !std::fs::symlink_metadata(path)?.is_file() {
        return Ok(None);
    }
    let mut file = File::open(path)?;
    let found = file.metadata()?;
    let stamp = Stamp::of(&found);
    let seen = known.lock().unwrap_or_else(|e| e.into_inner()).clone();
    let etag = match seen {
        Some((of, etag)) if of == stamp => etag,
        _ => {
            let mut hasher = blake3::Hasher::new();
            hasher.update_reader(&mut file)?;
            let etag = index::etag(&hasher.finalize());
            *known.lock().unwrap_or_else(|e| e.into_inner()) = Some((stamp, etag.clone()));
            file.rewind()?;
            etag
        }
    };
    let mut magic = [0; 2];
    let is_gzip = found.len() > 2 && file.read_exact(&mut magic).is_ok() && magic == [0x1f, 0x8b];
    Ok(Some(Opened { file, bytes: found.len(), etag, is_gzip }))
}

/// A range of a file as a response body. A file that shrinks meanwhile breaks the connection off.
pub(super) struct FileBody {
    left: u64,
    reading: Option<JoinHandle<io::Result<(File, Bytes)>>>,
}

impl FileBody {
    /// The bytes `range` of `file`.
    pub(super) fn new(mut file: File, range: Range<u64>) -> Self {
        let left = range.end - range.start;
        let reading = (left > 0).then(|| {
            tokio::task::spawn_blocking(move || {
                file.seek(SeekFrom::Start(range.start))?;
                read_piece(file, left)
            })
        });
        Self { left, reading }
    }
}

fn read_piece(mut file: File, left: u64) -> io::Result<(File, Bytes)> {
    let mut piece = vec![0; left.min(PIECE_BYTES) as usize];
    file.read_exact(&mut piece)?;
    Ok((file, piece.into()))
}

impl Body for FileBody {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<io::Result<Frame<Bytes>>>> {
        let Some(reading) = &mut self.reading else {
            return Poll::Ready(None);
        };
        let read = ready!(Pin::new(reading).poll(context)).map_err(io::Error::other).flatten();
        self.reading = None;
        let (file, piece) = match read {
            Ok(read) => read,
            Err(error) => return Poll::Ready(Some(Err(error))),
        };
        self.left -= piece.len() as u64;
        let left = self.left;
        if left > 0 {
            self.reading = Some(tokio::task::spawn_blocking(move || read_piece(file, left)));
        }
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        self.reading.is_none()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(self.left)
    }
}
