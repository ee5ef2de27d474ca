//! Tests of the image files: every kind that cameras and datasets write, and damaged ones.

use png::{BitDepth, ColorType};

use crate::capture::decode_error::DecodeError;
use crate::capture::image_file::{
    ImageFileReader, decode_gray_into, write_depth_png, write_gray_png,
};
use crate::capture::test_images::{flat_block_jpeg, png_of};

fn decode(bytes: &[u8], width: usize, height: usize) -> Result<Vec<u8>, DecodeError> {
    let mut gray = vec![0; width * height];
    decode_gray_into(bytes, width, height, &mut Vec::new(), &mut gray).map(|()| gray)
}

#[test]
fn png_of_every_kind_becomes_grey() {
    // Red, green, blue, white as 8-bit samples, where the kind can hold them.
    let luma = [76, 150, 29, 255];
    let rgb: &[u8] = &[255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255];
    let rgba: Vec<u8> = rgb.chunks(3).flat_map(|c| [c[0], c[1], c[2], 7]).collect();
    let wide = |samples: &[u8]| samples.iter().flat_map(|&s| [s, 99]).collect::<Vec<u8>>();
    let with_alpha: Vec<u8> = luma.iter().flat_map(|&g| [g, 7]).collect();
    use BitDepth::{Eight, Four, One, Sixteen, Two};
    use ColorType::{Grayscale, GrayscaleAlpha, Indexed, Rgb, Rgba};
    for (color, depth, palette, samples, expected) in [
        (Grayscale, Eight, None, luma.to_vec(), luma),
        (Grayscale, Sixteen, None, wide(&luma), luma),
        (Grayscale, One, None, vec![0b1010_0000], [255, 0, 255, 0]),
        (Grayscale, Two, None, vec![0b00_01_10_11], [0, 85, 170, 255]),
        (Grayscale, Four, None, vec![0x0f, 0x5a], [0, 255, 85, 170]),
        (GrayscaleAlpha, Eight, None, with_alpha.clone(), luma),
        (GrayscaleAlpha, Sixteen, None, wide(&with_alpha), luma),
        (Rgb, Eight, None, rgb.to_vec(), luma),
        (Rgb, Sixteen, None, wide(rgb), luma),
        (Rgba, Eight, None, rgba.clone(), luma),
        (Rgba, Sixteen, None, wide(&rgba), luma),
        (Indexed, Eight, Some(rgb), vec![0, 1, 2, 3], luma),
        (Indexed, Two, Some(rgb), vec![0b11_10_01_00], [255, 29, 150, 76]),
    ] {
        let file = png_of(4, 1, color, depth, palette, &samples);
        assert_eq!(decode(&file, 4, 1).expect("valid"), expected, "{color:?} {depth:?}");
    }
}

#[test]
fn jpeg_of_every_kind_becomes_grey() {
    let level = |u: usize, v: usize, c: u8| (40 + 30 * u + 50 * v + 17 * c as usize) as u8;
    let block = |i: usize| (i % 24 / 8, i / 24 / 8);
    for components in [1, 3] {
        let file = flat_block_jpeg(24, 16, components, false, level);
        for (i, gray) in decode(&file, 24, 16).expect("valid").into_iter().enumerate() {
            // The Y of a colour file is its grey.
            let (u, v) = block(i);
            assert_eq!(gray, level(u, v, 0), "{components} components, pixel {i}");
        }
    }
    let file = flat_block_jpeg(24, 16, 3, true, level);
    for (i, gray) in decode(&file, 24, 16).expect("valid").into_iter().enumerate() {
        let (u, v) = block(i);
        let [r, g, b] = [0, 1, 2].map(|c| f64::from(level(u, v, c)));
        let luma = 0.299 * r + 0.587 * g + 0.114 * b;
        assert!((f64::from(gray) - luma).abs() < 1.0, "pixel {i}: {gray} for {luma}");
    }
}

/// A file truncated anywhere is never an image.
#[test]
fn a_truncated_file_is_an_error_wherever_it_ends() {
    let jpeg = flat_block_jpeg(32, 32, 3, false, |u, v, _| (u * 40 + v * 9) as u8);
    let noise: Vec<u8> =
        (0..32 * 32u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let png = png_of(32, 32, ColorType::Grayscale, BitDepth::Eight, None, &noise);
    for file in [jpeg, png] {
        assert!(decode(&file, 32, 32).is_ok());
        for length in 0..file.len() {
            assert!(decode(&file[..length], 32, 32).is_err(), "{length} of {}", file.len());
        }
    }
}

#[test]
fn corrupt_bytes_give_an_error_or_an_image_but_never_a_panic() {
    let jpeg = flat_block_jpeg(16, 16, 3, false, |u, v, _| (u * 40 + v * 9) as u8);
    let png = png_of(16, 16, ColorType::Rgb, BitDepth::Eight, None, &[90; 16 * 16 * 3]);
    for file in [jpeg, png] {
        for at in 0..file.len() {
            for flip in [0x01, 0x80, 0xff] {
                let mut broken = file.clone();
                broken[at] ^= flip;
                // Whether it is noticed depends on the byte; the process must survive it.
                let _ = decode(&broken, 16, 16);
            }
        }
    }
    // A PNG has checksums: pixels never change unnoticed.
    let mut broken = png_of(16, 16, ColorType::Grayscale, BitDepth::Eight, None, &[90; 256]);
    let at = broken.len() - 20;
    broken[at] ^= 1;
    assert!(decode(&broken, 16, 16).is_err());
}

#[test]
fn an_absurd_size_is_refused_before_it_is_allocated() {
    let mut png = png_of(16, 16, ColorType::Rgb, BitDepth::Sixteen, None, &[90; 16 * 16 * 6]);
    png[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    assert!(decode(&png, 16, 16).is_err());
    let mut jpeg = flat_block_jpeg(16, 16, 1, false, |_, _, _| 90);
    let frame = jpeg.windows(2).position(|pair| pair == [0xff, 0xc0]).expect("frame header");
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0xff; 4]);
    assert!(decode(&jpeg, 16, 16).is_err());
}

#[test]
fn errors_name_the_file_and_what_to_do() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("frame.png");
    let mut reader = ImageFileReader::default();
    let mut read = |bytes: Option<&[u8]>| {
        if let Some(bytes) = bytes {
            std::fs::write(&path, bytes).expect("written");
        }
        let result = reader.read_gray_into(&path, 16, 16, &mut [0; 256]);
        result.expect_err("bad file").to_string()
    };
    let small = png_of(8, 16, ColorType::Grayscale, BitDepth::Eight, None, &[0; 128]);
    for (bytes, expected) in [
        (None, "frame.png: cannot be read"),
        (Some(&b""[..]), "is empty; copy the file again"),
        (Some(&b"GIF89a.."[..]), "convert it to one of them"),
        (Some(&small[..small.len() - 9]), "is 8x16 pixels, but the rig expects 16x16"),
        (Some(&[0xff, 0xd8, 0xff, 0xe0][..]), "is a damaged JPEG (it ends before its last marker)"),
    ] {
        let message = read(bytes);
        assert!(message.contains(expected) && message.contains("frame.png"), "{message}");
        assert!(!message.contains('\n'), "{message}");
    }
}

#[test]
fn written_files_are_read_back() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("image.png");
    let mut reader = ImageFileReader::default();
    let gray: Vec<u8> = (0..17 * 16).map(|i| (i % 256) as u8).collect();
    write_gray_png(&path, 17, 16, &gray).expect("written");
    let mut back = vec![0; gray.len()];
    reader.read_gray_into(&path, 17, 16, &mut back).expect("read");
    assert_eq!(gray, back);
    assert!(reader.read_depth(&path, 17, 16).is_err(), "8-bit grey is no depth");

    let steps: Vec<u16> = (0..17 * 16).map(|i| i * 200).collect();
    write_depth_png(&path, 17, 16, &steps).expect("written");
    let depth = reader.read_depth(&path, 17, 16).expect("read");
    for (&step, &metres) in steps.iter().zip(depth.pixels()) {
        assert_eq!(metres, f32::from(step) / 5000.0);
    }
    assert_eq!(
        std::fs::read_dir(folder.path()).expect("folder").count(),
        1,
        "nothing is left over"
    );

    assert!(write_gray_png(&path, 18, 16, &gray).is_err(), "too few pixels");
    let nowhere = folder.path().join("none/image.png");
    let message = write_gray_png(&nowhere, 17, 16, &gray).expect_err("no folder").to_string();
    assert!(message.contains("none/image.png: cannot be written"), "{message}");
}
