//! Colour scales and pictures: how numbers become colours.

use crate::capture::png_image::encode_rgb;

/// Red, green, blue.
pub type Rgb = [u8; 3];

/// Stops of the scale for inverse depth, far to near: from dark blue over green to dark red, as
/// distances are shown in robotics.
const RAINBOW: [Rgb; 9] = [
    [48, 18, 59],
    [70, 107, 227],
    [40, 188, 235],
    [50, 242, 152],
    [164, 252, 60],
    [238, 207, 58],
    [251, 126, 33],
    [210, 49, 5],
    [122, 4, 3],
];

/// Stops of the scale for uncertainty and density, low to high: increasing lightness, none too dark to be seen on a
/// darkened image.
const HEAT: [Rgb; 6] = [
    [60, 90, 220],
    [120, 90, 225],
    [195, 85, 195],
    [240, 100, 110],
    [255, 170, 60],
    [255, 245, 150],
];

/// Colour of `share` (0 to 1, clamped; NaN counts as 0) on the scale for inverse depth.
pub fn rainbow(share: f64) -> Rgb {
    between(&RAINBOW, share)
}

/// Colour of `share` on the scale for uncertainty and density.
pub fn heat(share: f64) -> Rgb {
    between(&HEAT, share)
}

fn between(stops: &[Rgb], share: f64) -> Rgb {
    let last = stops.len() - 1;
    let place = share.clamp(0.0, 1.0) * last as f64;
    // The cast maps NaN to 0.
    let lower = (place as usize).min(last - 1);
    let fraction = place - lower as f64;
    std::array::from_fn(|channel| {
        let (from, to) = (f64::from(stops[lower][channel]), f64::from(stops[lower + 1][channel]));
        (from + (to - from) * fraction).round() as u8
    })
}

/// An RGB picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Row by row.
    pub pixels: Vec<Rgb>,
}

impl Picture {
    /// Colours a pixel if it lies in the picture.
    pub fn paint(&mut self, column: usize, row: usize, colour: Rgb) {
        if column < self.width && row < self.height {
            self.pixels[row * self.width + column] = colour;
        }
    }

    /// The picture as the bytes of a PNG file; `None` where its size and pixels disagree.
    pub fn png(&self) -> Option<Vec<u8>> {
        encode_rgb(self.width, self.height, self.pixels.as_flattened()).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_reach_their_ends_and_accept_any_number() {
        assert_eq!(rainbow(0.0), RAINBOW[0]);
        assert_eq!(rainbow(1.0), RAINBOW[8]);
        assert_eq!(rainbow(0.125), RAINBOW[1]);
        assert_eq!(heat(f64::INFINITY), HEAT[5]);
        assert_eq!(heat(-3.0), HEAT[0]);
        let _ = heat(f64::NAN);
    }

    #[test]
    fn only_a_complete_picture_becomes_a_png() {
        let picture = Picture { width: 3, height: 2, pixels: vec![[9; 3]; 6] };
        assert!(picture.png().unwrap().starts_with(b"\x89PNG"));
        assert_eq!(Picture { width: 4, ..picture }.png(), None);
    }
}
