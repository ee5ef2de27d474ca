//! Pictures of every keyframe as files, for whoever works on the depth filter.

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use crate::service::atomic_file::write_atomically;
use crate::service::results::ResultsError;
use crate::service::results::colour::Picture;
use crate::service::results::pictures::{density_picture, inverse_depth_picture, variance_picture};
use crate::slam::mapper::Map;

/// Writes `keyframe-NNNN-{inverse-depth,variance,density}.png` for every keyframe into `dir`.
/// Points of any variance are shown.
pub fn write_debug_pictures(dir: &Path, map: &Map) -> Result<(), ResultsError> {
    let at = |path: &Path, source| ResultsError::Write { path: path.to_path_buf(), source };
    fs::create_dir_all(dir).map_err(|source| at(dir, source))?;
    for keyframe in &map.keyframes {
        let pictures = [
            ("inverse-depth", inverse_depth_picture(keyframe, f64::INFINITY).0),
            ("variance", variance_picture(keyframe)),
            ("density", density_picture(keyframe)),
        ];
        for (kind, picture) in pictures {
            let path = dir.join(format!("keyframe-{:04}-{kind}.png", keyframe.keyframe_id));
            write_picture(&path, &picture).map_err(|source| at(&path, source))?;
        }
    }
    Ok(())
}

fn write_picture(path: &Path, picture: &Picture) -> io::Result<()> {
    let bytes = picture.png().ok_or(io::ErrorKind::InvalidData)?;
    write_atomically(path, |file| file.write_all(&bytes))
}
