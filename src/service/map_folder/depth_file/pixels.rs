//! Positions of a keyframe's points: one bit per pixel or, where that is shorter, the number of pixels between one
//! point and the next: a byte, after one of 255 for every 255 of them.

/// A byte that counts this many pixels and is not the last of its number.
const MORE: u8 = u8::MAX;

/// Bytes at one bit per pixel.
pub(super) fn bit_bytes(num_pixels: usize) -> usize {
    num_pixels.div_ceil(8)
}

/// The shorter code of pixels, which are in order, each once.
pub(super) fn encode(pixels: impl Iterator<Item = usize> + Clone, num_pixels: usize) -> Vec<u8> {
    let mut gaps = Vec::new();
    let mut next = 0;
    for pixel in pixels.clone() {
        let gap = pixel - next;
        next = pixel + 1;
        gaps.extend(std::iter::repeat_n(MORE, gap / usize::from(MORE)));
        gaps.push((gap % usize::from(MORE)) as u8);
        if gaps.len() >= bit_bytes(num_pixels) {
            let mut bits = vec![0u8; bit_bytes(num_pixels)];
            pixels.for_each(|pixel| bits[pixel / 8] |= 1 << (pixel % 8));
            return bits;
        }
    }
    gaps
}

/// The pixels of a code from [`encode`], in order, each once and below `num_pixels`; `None` where their number is not
/// `count`.
pub(super) fn decode(code: &[u8], num_pixels: usize, count: usize) -> Option<Vec<usize>> {
    let mut pixels = Vec::with_capacity(count.min(num_pixels));
    if code.len() == bit_bytes(num_pixels) {
        for (index, byte) in code.iter().enumerate() {
            let set = (0..8).filter(|bit| byte >> bit & 1 == 1);
            pixels.extend(set.map(|bit| index * 8 + bit));
        }
    } else {
        let mut next = 0;
        let mut is_whole = true;
        for &byte in code {
            next += usize::from(byte);
            is_whole = byte != MORE;
            if is_whole {
                pixels.push(next);
                next += 1;
            }
        }
        if !is_whole {
            return None;
        }
    }
    let is_inside = pixels.last().is_none_or(|last| *last < num_pixels);
    (is_inside && pixels.len() == count).then_some(pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_and_many_pixels_are_decoded() {
        const NUM: usize = 5003;
        for (step, is_short) in
            [(1, false), (2, false), (28, true), (255, true), (256, true), (600, true)]
        {
            for first in [0, 1, 254, 255, 256] {
                let pixels: Vec<usize> = (first..NUM).step_by(step).collect();
                let code = encode(pixels.iter().copied(), NUM);
                assert_eq!(code.len() < bit_bytes(NUM), is_short, "{step}: {}", code.len());
                assert_eq!(decode(&code, NUM, pixels.len()), Some(pixels), "{step} from {first}");
            }
        }
        assert!(encode([].into_iter(), NUM).is_empty());
        assert_eq!(decode(&[], NUM, 0), Some(vec![]));
    }

    #[test]
    fn an_invalid_code_is_refused() {
        assert_eq!(decode(&[5, 6], 1000, 3), None, "one is missing");
        assert_eq!(decode(&[5, 255], 1000, 1), None, "cut");
        assert_eq!(decode(&[255, 255, 255, 255], 100, 4), None);
        assert_eq!(decode(&[99], 100, 1), Some(vec![99]));
        assert_eq!(decode(&[100], 100, 1), None, "outside");
        assert_eq!(decode(&[0xff, 0xff], 12, 16), None, "bits outside");
    }
}
