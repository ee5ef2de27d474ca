//! The content of a chunk: uncompressed, LZ4 or Zstandard, decoded in Rust.

use std::io::{Error, Read, Result};

use mcap::records::ChunkHeader;

/// Maximum size of a chunk's content: far above what recorders write (a few MB), and above what one image of the
/// largest size with four 16-bit channels needs.
pub const MAX_CHUNK_BYTES: u64 = 1 << 30;

/// Writes the content of a chunk into `content`, replacing its old content. It grows as bytes arrive, whatever size the
/// header claims.
pub fn decompress_into(header: &ChunkHeader, data: &[u8], content: &mut Vec<u8>) -> Result<()> {
    content.clear();
    if header.uncompressed_size > MAX_CHUNK_BYTES {
        return Err(Error::other(format!("a chunk of {} bytes", header.uncompressed_size)));
    }
    // One byte more than announced reveals a longer chunk.
    let most = header.uncompressed_size + 1;
    match header.compression.as_str() {
        "" => content.extend_from_slice(data),
        "lz4" => {
            lz4_flex::frame::FrameDecoder::new(data).take(most).read_to_end(content)?;
        }
        "zstd" => {
            let decoder = ruzstd::decoding::StreamingDecoder::new(data);
            decoder.map_err(Error::other)?.take(most).read_to_end(content)?;
        }
        other => {
            let other: String = other.chars().take(20).collect();
            return Err(Error::other(format!("a chunk with the unknown compression `{other}`")));
        }
    }
    if content.len() as u64 != header.uncompressed_size {
        return Err(Error::other(format!(
            "a chunk of {} bytes that announces {}",
            content.len(),
            header.uncompressed_size
        )));
    }
    let is_checked = header.uncompressed_crc != 0;
    if is_checked && crc32fast::hash(content) != header.uncompressed_crc {
        return Err(Error::other("a chunk whose checksum is wrong"));
    }
    Ok(())
}
