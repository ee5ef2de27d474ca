//! Pictures of every keyframe as files, for work on the depth filter or the alignment.

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use rayon::prelude::*;

use crate::service::atomic_file::write_atomically;
use crate::service::results::colour::Picture;
use crate::service::results::pictures::{density_picture, inverse_depth_picture, variance_picture};
use crate::service::results::results_error::ResultsError;
use crate::service::results::weight_picture::weight_picture;
use crate::slam::map::Map;
use crate::slam::tracker::TrackerParams;

/// Writes `keyframe-NNNN-{inverse-depth,variance,density,weights}.png` for every keyframe into `dir`.
/// Points of any variance are shown; the weights are those of a tracker with `params`.
pub fn write_debug_pictures(
    dir: &Path,
    map: &Map,
    params: &TrackerParams,
) -> Result<(), ResultsError> {
    let at = |path: &Path, source| ResultsError::Write { path: path.to_path_buf(), source };
    fs::create_dir_all(dir).map_err(|source| at(dir, source))?;
    map.keyframes.par_iter().try_for_each(|keyframe| {
        let pictures = [
            ("inverse-depth", Some(inverse_depth_picture(keyframe, f64::INFINITY).0)),
            ("variance", Some(variance_picture(keyframe))),
            ("density", Some(density_picture(keyframe))),
            ("weights", weight_picture(keyframe, params)),
        ];
        for (kind, picture) in pictures {
            let Some(picture) = picture else { continue };
            let path = dir.join(format!("keyframe-{:04}-{kind}.png", keyframe.keyframe_id));
            write_picture(&path, &picture).map_err(|source| at(&path, source))?;
        }
        Ok(())
    })
}

fn write_picture(path: &Path, picture: &Picture) -> io::Result<()> {
    let bytes = picture.png().ok_or(io::ErrorKind::InvalidData)?;
    write_atomically(path, |file| file.write_all(&bytes))
}
