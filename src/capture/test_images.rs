//! Image files for tests: a JPEG encoder for flat 8×8 blocks, and PNGs of every kind.

/// Bits of a JPEG scan, with a zero stuffed after every 0xff.
#[derive(Default)]
struct ScanBits {
    bytes: Vec<u8>,
    pending: u32,
    count: u32,
}

impl ScanBits {
    fn push(&mut self, value: u32, length: u32) {
        for bit in (0..length).rev() {
            self.pending = self.pending << 1 | (value >> bit & 1);
            self.count += 1;
            if self.count == 8 {
                let byte = self.pending as u8;
                self.bytes.push(byte);
                if byte == 0xff {
                    self.bytes.push(0);
                }
                (self.pending, self.count) = (0, 0);
            }
        }
    }

    fn finish(mut self) -> Vec<u8> {
        while self.count != 0 {
            self.push(1, 1);
        }
        self.bytes
    }
}

/// A baseline JPEG whose 8×8 blocks are flat; `value(block_u, block_v, component)` is their level. One component is
/// grey, three are Y Cb Cr, or R G B if `is_rgb` (declared by an Adobe marker).
pub fn flat_block_jpeg(
    width: usize,
    height: usize,
    components: u8,
    is_rgb: bool,
    value: impl Fn(usize, usize, u8) -> u8,
) -> Vec<u8> {
    let mut file = vec![0xff, 0xd8];
    if is_rgb {
        file.extend(b"\xff\xee\x00\x0eAdobe\x00\x64\x00\x00\x00\x00\x00");
    }
    // Quantisation by 8 makes the DC coefficient, 8 × (level − 128), the plain difference.
    file.extend([0xff, 0xdb, 0, 67, 0]);
    file.extend([8; 64]);
    let [high, low] = (height as u16).to_be_bytes();
    let [left, right] = (width as u16).to_be_bytes();
    file.extend([0xff, 0xc0, 0, 8 + 3 * components, 8, high, low, left, right, components]);
    (1..=components).for_each(|id| file.extend([id, 0x11, 0]));
    // DC: twelve codes of four bits. AC: "end of block" as the one bit 0.
    file.extend([0xff, 0xc4, 0, 31, 0x00, 0, 0, 0, 12]);
    file.extend([0; 12]);
    file.extend(0..12);
    file.extend([0xff, 0xc4, 0, 20, 0x10, 1]);
    file.extend([0; 16]);
    file.extend([0xff, 0xda, 0, 6 + 2 * components, components]);
    (1..=components).for_each(|id| file.extend([id, 0]));
    file.extend([0, 63, 0]);
    let mut bits = ScanBits::default();
    let mut before = [0i32; 3];
    for block_v in 0..height.div_ceil(8) {
        for block_u in 0..width.div_ceil(8) {
            for component in 0..components {
                let level = i32::from(value(block_u, block_v, component)) - 128;
                let difference = level - std::mem::replace(&mut before[component as usize], level);
                let length = 32 - difference.unsigned_abs().leading_zeros();
                bits.push(length, 4);
                // Negative values are written as their one's complement.
                let code = if difference < 0 { difference - 1 } else { difference };
                bits.push(code as u32, length);
                bits.push(0, 1);
            }
        }
    }
    file.extend(bits.finish());
    file.extend([0xff, 0xd9]);
    file
}

/// A PNG of any colour type and bit depth.
pub fn png_of(
    width: u32,
    height: u32,
    color: png::ColorType,
    depth: png::BitDepth,
    palette: Option<&[u8]>,
    samples: &[u8],
) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    if let Some(palette) = palette {
        encoder.set_palette(palette.to_vec());
    }
    let mut writer = encoder.write_header().expect("header");
    writer.write_image_data(samples).expect("samples");
    writer.finish().expect("end");
    bytes
}
