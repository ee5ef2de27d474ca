//! Frames prepared before they are needed: in memory, or in a file that outlives the process, so that a capture process
//! that replaces a killed one does not prepare them again.

use std::borrow::Cow;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

/// First bytes of a file of frames, with the version of its layout.
const MAGIC: [u8; 16] = *b"semidense fr. 1\n";
/// The magic, then bytes of a frame, number of frames, and 1 if these are all.
const HEADER_BYTES: usize = MAGIC.len() + 3 * 8;
/// Offset of the first frame: a page boundary.
const FIRST_FRAME: u64 = 4096;

/// Frames of one size, in order.
#[derive(Debug)]
pub struct FrameStore {
    /// Bytes of a frame.
    pub frame_bytes: usize,
    is_complete: bool,
    kept: Kept,
}

#[derive(Debug)]
enum Kept {
    Memory(Vec<Vec<u8>>),
    File { file: File, count: usize },
}

impl FrameStore {
    /// Creates an empty store in memory.
    pub fn in_memory(frame_bytes: usize) -> Self {
        Self { frame_bytes, is_complete: false, kept: Kept::Memory(Vec::new()) }
    }

    /// Opens the frames that another process has stored in `file`, which may be empty.
    pub fn in_file(file: File, frame_bytes: usize) -> io::Result<Self> {
        let mut header = [0; HEADER_BYTES];
        let is_whole = file.metadata()?.len() >= FIRST_FRAME;
        if is_whole {
            file.read_exact_at(&mut header, 0)?;
        }
        let number = |index: usize| {
            let begin = MAGIC.len() + 8 * index;
            let bytes = header[begin..begin + 8].try_into().unwrap_or_default();
            usize::try_from(u64::from_le_bytes(bytes)).unwrap_or(0)
        };
        if is_whole && header.starts_with(&MAGIC) && number(0) == frame_bytes {
            let kept = Kept::File { file, count: number(1) };
            return Ok(Self { frame_bytes, is_complete: number(2) == 1, kept });
        }
        file.set_len(0)?;
        file.set_len(FIRST_FRAME)?;
        let kept = Kept::File { file, count: 0 };
        let mut store = Self { frame_bytes, is_complete: false, kept };
        store.write_header()?;
        Ok(store)
    }

    /// Number of frames so far.
    pub fn len(&self) -> usize {
        match &self.kept {
            Kept::Memory(frames) => frames.len(),
            Kept::File { count, .. } => *count,
        }
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether the store holds all frames.
    pub fn is_complete(&self) -> bool {
        self.is_complete
    }

    /// Marks the store as complete.
    pub fn complete(&mut self) -> io::Result<()> {
        self.is_complete = true;
        self.write_header()
    }

    /// Adds a frame. In a file it counts only once completely written.
    pub fn push(&mut self, pixels: Vec<u8>) -> io::Result<()> {
        if pixels.len() != self.frame_bytes {
            return Err(io::ErrorKind::InvalidInput.into());
        }
        match &mut self.kept {
            Kept::Memory(frames) => frames.push(pixels),
            Kept::File { file, count } => {
                file.write_all_at(&pixels, place(*count, self.frame_bytes))?;
                *count += 1;
                self.write_header()?;
            }
        }
        Ok(())
    }

    /// Returns frame `index`; `None` if it is missing.
    pub fn get(&self, index: usize) -> Option<Cow<'_, [u8]>> {
        match &self.kept {
            Kept::Memory(frames) => frames.get(index).map(|frame| Cow::Borrowed(&frame[..])),
            Kept::File { file, count } => {
                let mut pixels = vec![0; self.frame_bytes];
                (index < *count).then_some(())?;
                file.read_exact_at(&mut pixels, place(index, self.frame_bytes)).ok()?;
                Some(Cow::Owned(pixels))
            }
        }
    }

    fn write_header(&mut self) -> io::Result<()> {
        let Kept::File { file, count } = &self.kept else { return Ok(()) };
        let numbers = [self.frame_bytes as u64, *count as u64, u64::from(self.is_complete)];
        let mut header = MAGIC.to_vec();
        numbers.iter().for_each(|number| header.extend(number.to_le_bytes()));
        file.write_all_at(&header, 0)
    }
}

fn place(index: usize, frame_bytes: usize) -> u64 {
    FIRST_FRAME + index as u64 * frame_bytes as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_passes_its_frames_to_the_next_process() {
        let file = tempfile::tempfile().unwrap();
        let open = |bytes| FrameStore::in_file(file.try_clone().unwrap(), bytes).unwrap();
        let mut first = open(6);
        assert!(first.is_empty() && first.get(0).is_none());
        first.push(vec![1; 6]).unwrap();
        first.push(vec![2; 6]).unwrap();
        assert!(first.push(vec![3; 5]).is_err());
        let mut second = open(6);
        assert_eq!((second.len(), second.is_complete()), (2, false));
        assert_eq!(second.get(1).unwrap()[..], [2; 6]);
        second.push(vec![3; 6]).unwrap();
        second.complete().unwrap();
        let third = open(6);
        assert_eq!((third.len(), third.is_complete()), (3, true));
        assert!(third.get(3).is_none());
        assert!(open(7).is_empty(), "frames of another size are not taken");
    }

    #[test]
    fn memory_and_file_hold_the_same() {
        let mut stores = [
            FrameStore::in_memory(4),
            FrameStore::in_file(tempfile::tempfile().unwrap(), 4).unwrap(),
        ];
        for store in &mut stores {
            store.push(vec![7; 4]).unwrap();
            store.push(vec![9; 4]).unwrap();
            store.complete().unwrap();
            assert_eq!((store.len(), store.is_complete()), (2, true));
            assert_eq!(store.get(1).unwrap()[..], [9; 4]);
            assert!(store.get(2).is_none());
        }
    }
}
