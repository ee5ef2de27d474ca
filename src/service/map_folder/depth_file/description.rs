//! The appearance of a keyframe, in its file: number of features (u32); for each column and row (u16), orientation,
//! scale (u8) and descriptor (4 × u64); the CRC-32 of these (u32).

use zerocopy::IntoBytes;

use crate::service::bytes::take;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::places::{Description, Feature, FeaturePlace, MAX_FEATURES};

/// Bytes of a feature.
const FEATURE_BYTES: usize = 2 + 2 + 1 + 1 + 4 * 8;
/// Bytes of the number of features, and of the checksum.
const NUMBER_BYTES: usize = 4;
/// Most bytes of a description.
pub(super) const MAX_BYTES: usize = 2 * NUMBER_BYTES + MAX_FEATURES * FEATURE_BYTES;

/// Encodes a description.
pub(super) fn encode(description: &Description) -> Vec<u8> {
    let features = description.features();
    let mut bytes = Vec::with_capacity(MAX_BYTES);
    bytes.extend((features.len() as u32).to_le_bytes());
    for Feature { place, bits } in features {
        bytes.extend([place.u, place.v].as_bytes());
        bytes.extend([place.orientation, place.scale]);
        bytes.extend(bits.as_bytes());
    }
    bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
    bytes
}

/// Decodes the description of an image of `camera`; `None` where it is damaged or absent.
pub(super) fn decode(bytes: &[u8], camera: &Intrinsics) -> Option<Description> {
    let (body, checksum) = bytes.split_last_chunk::<NUMBER_BYTES>()?;
    let (count, features) = body.split_first_chunk::<NUMBER_BYTES>()?;
    let is_whole = crc32fast::hash(body) == u32::from_le_bytes(*checksum)
        && features.len() % FEATURE_BYTES == 0
        && features.len() / FEATURE_BYTES == u32::from_le_bytes(*count) as usize;
    if !is_whole {
        return None;
    }
    let feature = |mut bytes: &[u8]| {
        let ([u, v], [orientation, scale]) = (take(&mut bytes)?, take(&mut bytes)?);
        let place = FeaturePlace { u, v, orientation, scale };
        Some(Feature { place, bits: take(&mut bytes)? })
    };
    let features = features.chunks_exact(FEATURE_BYTES).map(feature);
    Description::of_features(camera.width, camera.height, features.collect::<Option<_>>()?)
}
