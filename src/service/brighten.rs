//! Brightens dim images as they are read, and logs it.

use crate::slam::image::brightening::Brightening;

/// Brightens a dim image and logs a change of the factor.
pub(crate) fn brighten(brightening: &mut Brightening, pixels: &mut [u8], width: usize) {
    let before = brightening.factor();
    brightening.apply(pixels, width);
    match brightening.factor() {
        factor if factor == before => {}
        1 => tracing::info!("the images are bright enough again"),
        factor => tracing::warn!(
            "the images are dim; their grey levels are multiplied by {factor}. Add light or expose longer"
        ),
    }
}
