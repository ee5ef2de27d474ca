//! Bags that the tests write themselves: every encoding, damaged files, several topics.

use std::path::PathBuf;

use super::*;
use crate::capture::png_image::encode_gray;
use crate::capture::source_name::SourceName;
use crate::capture::test_bag::{
    TestBag, camera_info, compressed_image, frame_record, image, record,
};
use crate::capture::test_images::flat_block_jpeg;
use crate::capture::v4l::stamps::MAX_REFUSED_IN_A_ROW;
use crate::slam::geometry::camera_model::Distortion;

const WIDTH: u32 = 32;
const HEIGHT: u32 = 24;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;
const K: [f64; 4] = [30.0, 31.0, 15.5, 11.5];
const IMAGE: &str = "sensor_msgs/msg/Image";

struct Written {
    _folder: tempfile::TempDir,
    path: PathBuf,
}

fn written(bytes: &[u8]) -> Written {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    std::fs::write(&path, bytes).unwrap();
    Written { _folder: folder, path }
}

/// A bag with a camera and images on `/cam/image_raw`: the number of each is its grey value.
fn camera_bag(num: u8) -> TestBag {
    let mut bag = TestBag::default();
    let images = bag.topic("/cam/image_raw", IMAGE);
    let camera = bag.topic("/cam/camera_info", "sensor_msgs/msg/CameraInfo");
    for i in 0..num {
        let nanos = 1_000_000_000 + i64::from(i) * 50_000_000;
        bag.message(camera, nanos, &camera_info(WIDTH, HEIGHT, "plumb_bob", &[0.0; 5], K, 0));
        bag.message(images, nanos, &image(nanos, WIDTH, HEIGHT, "mono8", WIDTH, &[i; PIXELS]));
        bag.end_chunk("", <[u8]>::to_vec);
    }
    bag
}

/// Middle pixel of every frame that can be read, and the errors of the others.
fn play(bag: &mut Bag) -> (Vec<(u64, u8)>, Vec<String>) {
    let (mut pixels, mut frames, mut errors) = (vec![0; PIXELS], Vec::new(), Vec::new());
    loop {
        match bag.next_into(&mut pixels) {
            Ok(Some(stamp)) => frames.push((stamp.sequence, pixels[PIXELS / 2 + 16])),
            Ok(None) => return (frames, errors),
            Err(error) if error.is_transient() => errors.push(error.to_string()),
            Err(error) => panic!("{error}"),
        }
    }
}

fn opened(bytes: &[u8], topic: Option<&str>) -> (Written, Result<Bag, SourceError>) {
    let file = written(bytes);
    let bag = open(&file.path, topic, None);
    (file, bag)
}

/// Numbers and stamps of the frames of a bag whose images have these header and log times, and how many are refused.
fn stamps_of(times: &[(i64, i64)]) -> (Vec<(u64, i64)>, usize) {
    let mut bag = camera_bag(0);
    bag.message(2, 1, &camera_info(WIDTH, HEIGHT, "plumb_bob", &[], K, 0));
    for (header, log) in times {
        bag.message(1, *log, &image(*header, WIDTH, HEIGHT, "mono8", WIDTH, &[1; PIXELS]));
    }
    let (_file, bag) = opened(&bag.finish(), None);
    let (mut bag, mut pixels) = (bag.unwrap(), vec![0; PIXELS]);
    let (mut frames, mut refused) = (Vec::new(), 0);
    loop {
        match bag.next_into(&mut pixels) {
            Ok(Some(stamp)) => frames.push((stamp.sequence, stamp.capture_nanos)),
            Ok(None) => return (frames, refused),
            Err(error) => {
                assert!(error.to_string().contains("is not later"), "{error}");
                refused += 1;
            }
        }
    }
}

/// The file of `bag` with a summary that does not repeat the schemas: records of an unknown kind are in their place.
fn without_repeated_schemas(bag: TestBag) -> Vec<u8> {
    const SCHEMA: u8 = 3;
    const UNKNOWN: u8 = 0x80;
    const PREFIX_BYTES: usize = 9;
    /// The footer's content, which begins with the place of the summary, and the magic.
    const END_BYTES: usize = 20 + 8;
    let mut bytes = bag.finish();
    let number = |bytes: &[u8], at: usize| {
        u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize
    };
    let end = bytes.len() - END_BYTES;
    let mut at = number(&bytes, end);
    while at < end {
        if bytes[at] == SCHEMA {
            bytes[at] = UNKNOWN;
        }
        at += PREFIX_BYTES + number(&bytes, at + 1);
    }
    bytes
}

fn error_of(bytes: &[u8], topic: Option<&str>) -> String {
    let message = opened(bytes, topic).1.expect_err("an error").to_string();
    assert!(message.contains("a.mcap") && !message.contains('\n'), "{message}");
    message
}

#[test]
fn every_encoding_is_converted_to_grey() {
    let pixel = |bytes: &[u8]| bytes.repeat(PIXELS);
    let red = crate::slam::image::gray::gray_from_rgb([200, 100, 50]);
    for (encoding, bytes, expected) in [
        ("mono8", &[77][..], 77),
        ("8UC1", &[77], 77),
        ("mono16", &[3, 77], 77),
        ("16UC1", &[3, 77], 77),
        ("rgb8", &[200, 100, 50], red),
        ("bgr8", &[50, 100, 200], red),
        ("rgba8", &[200, 100, 50, 9], red),
        ("bgra8", &[50, 100, 200, 9], red),
        ("yuv422", &[9, 77], 77),
        ("yuv422_yuy2", &[77, 9], 77),
    ] {
        let mut bag = camera_bag(0);
        let bytes = pixel(bytes);
        let step = bytes.len() as u32 / HEIGHT;
        bag.message(2, 1, &camera_info(WIDTH, HEIGHT, "plumb_bob", &[], K, 0));
        bag.message(1, 1, &image(1, WIDTH, HEIGHT, encoding, step, &bytes));
        let (_file, bag) = opened(&bag.finish(), None);
        assert_eq!(play(&mut bag.unwrap()), (vec![(0, expected)], vec![]), "{encoding}");
    }
    // Padded rows; the last may end with its last pixel.
    let mut bag = camera_bag(0);
    let row = [[7; WIDTH as usize], [0; WIDTH as usize]].concat();
    let padded = row.repeat(HEIGHT as usize);
    bag.message(2, 1, &camera_info(WIDTH, HEIGHT, "", &[], K, 1));
    bag.message(1, 1, &image(1, WIDTH, HEIGHT, "mono8", 64, &padded[..padded.len() - 32]));
    let (_file, bag) = opened(&bag.finish(), None);
    assert_eq!(play(&mut bag.unwrap()).0, [(0, 7)]);
}

#[test]
fn compressed_images_and_compressed_chunks_are_read() {
    let gray = encode_gray(WIDTH as usize, HEIGHT as usize, png::BitDepth::Eight, &[90; PIXELS]);
    let jpeg = flat_block_jpeg(WIDTH as usize, HEIGHT as usize, 3, false, |_, _, _| 60);
    let lz4 = |bytes: &[u8]| {
        use std::io::Write;
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        encoder.write_all(bytes).unwrap();
        encoder.finish().unwrap()
    };
    let zstd = |bytes: &[u8]| {
        let level = ruzstd::encoding::CompressionLevel::Fastest;
        ruzstd::encoding::compress_to_vec(bytes, level)
    };
    let mut bag = TestBag::default();
    let images = bag.topic("/cam/image_raw/compressed", "sensor_msgs/msg/CompressedImage");
    let camera = bag.topic("/cam/camera_info", "sensor_msgs/msg/CameraInfo");
    bag.message(camera, 1, &camera_info(WIDTH, HEIGHT, "plumb_bob", &[0.0; 5], K, 0));
    bag.message(images, 1, &compressed_image(1, "png", &gray.unwrap()));
    bag.end_chunk("lz4", lz4);
    bag.message(images, 2, &compressed_image(2, "rgb8; jpeg compressed bgr8", &jpeg));
    bag.end_chunk("zstd", zstd);
    let (_file, bag) = opened(&bag.finish(), None);
    assert_eq!(play(&mut bag.unwrap()), (vec![(0, 90), (1, 60)], vec![]));
}

#[test]
fn a_file_without_an_end_is_played_to_its_last_complete_chunk() {
    let whole = camera_bag(3).finish();
    let (_file, bag) = opened(&whole, None);
    let mut bag = bag.unwrap();
    assert_eq!((bag.num_frames(), bag.take_notice()), (Some(3), None));
    assert_eq!(play(&mut bag).0, [(0, 0), (1, 1), (2, 2)]);
    // Cut before the footer, and within the last chunk.
    let unfinished = camera_bag(3).bytes;
    for (cut, expected) in [(0, 3), (1, 2), (500, 2)] {
        let (_file, bag) = opened(&unfinished[..unfinished.len() - cut], None);
        let mut bag = bag.unwrap();
        assert_eq!(bag.num_frames(), Some(expected), "{cut}");
        assert!(bag.take_notice().is_some_and(|notice| notice.text.contains("is truncated")));
        let (frames, errors) = play(&mut bag);
        assert_eq!((frames.len(), errors.len()), (expected, 0), "{cut}");
    }
}

#[test]
fn a_damaged_chunk_is_one_error_and_the_rest_follows() {
    let mut bytes = camera_bag(3).finish();
    // A changed pixel of the second image makes its chunk's checksum wrong.
    let run = [1; 100];
    let at = bytes.windows(100).position(|window| window == run).unwrap();
    bytes[at] = 9;
    let (_file, bag) = opened(&bytes, None);
    let (frames, errors) = play(&mut bag.unwrap());
    assert_eq!(frames, [(0, 0), (1, 2)]);
    assert!(errors.len() == 1 && errors[0].contains("checksum"), "{errors:?}");
}

#[test]
fn images_that_cannot_be_used_are_one_error_each() {
    let mut bag = camera_bag(1);
    let mut add = |nanos, message: &[u8]| bag.message(1, nanos, message);
    let later = 2_000_000_000;
    add(5, &image(later, WIDTH, HEIGHT, "yuv444", WIDTH, &[1; PIXELS]));
    add(5, &image(later + 1, WIDTH, HEIGHT, "mono8", WIDTH, &[1; PIXELS - 1]));
    add(5, &image(later + 2, WIDTH, HEIGHT, "mono8", 1, &[1; PIXELS]));
    add(5, &image(later + 3, 16, HEIGHT, "mono8", WIDTH, &[1; PIXELS]));
    add(5, &image(later + 3, WIDTH, HEIGHT, "mono8", WIDTH, &[1; PIXELS]));
    add(5, &[0, 1, 0, 0, 9]);
    add(5, &image(later + 9, WIDTH, HEIGHT, "mono8", WIDTH, &[8; PIXELS]));
    let (_file, bag) = opened(&bag.finish(), None);
    let (frames, errors) = play(&mut bag.unwrap());
    assert_eq!(frames, [(0, 0), (7, 8)]);
    let expected = [
        "`yuv444` is not supported; supported are",
        "767 of 768 bytes",
        "rows of 1 bytes",
        "is 16x24",
        "stamp",
        "end of input",
    ];
    for (error, expected) in errors.iter().zip(expected) {
        assert!(error.contains(expected) && error.contains("/cam/image_raw"), "{error}");
    }
    assert_eq!(errors.len(), expected.len());
}

#[test]
fn a_bag_has_one_clock() {
    let log = |number: i64| 1_700_000_000_000_000_000 + number * 33;
    // A simulation starts at 0; a later 0 is a disordered stamp.
    let times = [(0, log(0)), (33, log(1)), (0, log(2)), (99, log(3))];
    assert_eq!(stamps_of(&times), (vec![(0, 0), (1, 33), (3, 99)], 1));
    assert_eq!(stamps_of(&[(33, log(0)), (0, log(1))]), (vec![(0, 33)], 1));
    // Headers without stamps: the log times count to the end.
    let times = [(0, log(0)), (0, log(1)), (66, log(2))];
    assert_eq!(stamps_of(&times), (vec![(0, log(0)), (1, log(1)), (2, log(2))], 0));
    assert_eq!(stamps_of(&times[..1]), (vec![(0, log(0))], 0));
}

#[test]
fn a_step_of_the_clock_does_not_end_a_bag() {
    const SECOND: i64 = 1_000_000_000;
    // A clock that steps back, and one stamp far in the future.
    for before in [[1000_i64, 1001], [1, 2_000_000_000]] {
        let secs = before.into_iter().chain(11..=25);
        let times: Vec<(i64, i64)> = secs.map(|secs| (secs * SECOND, 5)).collect();
        let mut expected = vec![(0, before[0] * SECOND), (1, before[1] * SECOND)];
        let resumed = 2 + MAX_REFUSED_IN_A_ROW as usize;
        expected.extend((resumed..times.len()).map(|i| (i as u64, times[i].0)));
        assert_eq!(stamps_of(&times), (expected, MAX_REFUSED_IN_A_ROW as usize));
    }
}

#[test]
fn a_summary_without_schemas_is_not_trusted() {
    let (_file, bag) = opened(&without_repeated_schemas(camera_bag(3)), None);
    let mut bag = bag.unwrap();
    assert_eq!((bag.num_frames(), bag.take_notice()), (Some(3), None));
    assert!(!bag.marks_hidden(), "in another's bag 0 is black");
    assert_eq!(bag.readout_s(), Some(0.0));
    assert_eq!(play(&mut bag).0, [(0, 0), (1, 1), (2, 2)]);
}

#[test]
fn our_own_recordings_keep_number_stamp_and_exposure() {
    let mut bag = TestBag::default();
    let images = bag.topic("/semidense/image_rect", IMAGE);
    let camera = bag.topic("/semidense/camera_info", "sensor_msgs/msg/CameraInfo");
    let frames = bag.topic("/semidense/details/frame", "semidense_msgs/msg/Frame");
    bag.message(camera, 1, &camera_info(WIDTH, HEIGHT, "plumb_bob", &[0.1; 5], K, 0));
    for (sequence, stamp) in [(40_u64, 7_000_000_000_i64), (41, 7_100_000_000), (44, 7_400_000_000)]
    {
        bag.message(frames, stamp, &frame_record(stamp, sequence, stamp - 5_000_000_001, 3000));
        bag.message(images, stamp, &image(stamp, WIDTH, HEIGHT, "mono8", WIDTH, &[1; PIXELS]));
    }
    let (_file, bag) = opened(&bag.finish(), None);
    let mut bag = bag.unwrap();
    // Rectified by its name: the projection counts, not the lens.
    assert_eq!(bag.intrinsics().fx, 2.0 * K[0]);
    assert!(bag.marks_hidden());
    assert_eq!(bag.readout_s(), None, "its frames are as published");
    let mut pixels = vec![0; PIXELS];
    let mut found = Vec::new();
    while let Some(stamp) = bag.next_into(&mut pixels).unwrap() {
        found.push((stamp.sequence, stamp.capture_nanos, stamp.exposure_nanos, stamp.gain));
    }
    let expected = [
        (0, 1_999_999_999, 3000, 1.5),
        (1, 2_099_999_999, 3000, 1.5),
        (4, 2_399_999_999, 3000, 1.5),
    ];
    assert_eq!(found, expected);
}

#[test]
fn lenses_become_rigs_or_errors_that_say_what_to_do() {
    let rig = |model: &str, d: &[f64], binning| {
        let mut bag = camera_bag(0);
        bag.message(2, 1, &camera_info(WIDTH, HEIGHT, model, d, K, binning));
        bag.message(1, 1, &image(1, WIDTH, HEIGHT, "mono8", WIDTH, &[1; PIXELS]));
        let file = written(&bag.finish());
        let contents = Contents::read(&file.path, None).unwrap();
        contents.rig(&file.path).map_err(|error| error.to_string())
    };
    let lens = |model, d: &[f64]| rig(model, d, 0).map(|rig| *rig.camera.distortion());
    assert_eq!(lens("plumb_bob", &[0.0; 5]), Ok(Distortion::None));
    assert_eq!(lens("", &[0.0; 5]), Ok(Distortion::None));
    let radtan = [-0.1, 0.02, 0.0, 0.0, 0.001];
    assert_eq!(lens("plumb_bob", &radtan), Ok(Distortion::try_radtan(&radtan).unwrap()));
    let rational = [0.1, 0.02, 0.0, 0.0, 0.001, 0.01, 0.01, 0.01];
    let expected = Ok(Distortion::try_radtan(&rational).unwrap());
    assert_eq!(lens("rational_polynomial", &rational), expected);
    let long = [&rational[..], &[0.0; 6]].concat();
    assert_eq!(lens("rational_polynomial", &long), expected);
    let fisheye = [0.01, 0.0, 0.0, 0.0];
    assert_eq!(lens("equidistant", &fisheye), Ok(Distortion::try_equidistant(&fisheye).unwrap()));
    for (model, d, binning) in [
        ("plumb_bob", &[0.0; 3][..], 0),
        ("fov", &[0.9], 0),
        ("plumb_bob", &[], 2),
        ("", &[0.1], 0),
    ] {
        let error = rig(model, d, binning).unwrap_err();
        assert!(error.contains("/cam/image_raw") && error.contains("--rig FILE"), "{error}");
    }
}

#[test]
fn several_topics_no_topic_and_no_camera_are_errors() {
    let mut bag = camera_bag(1);
    let right = bag.topic("/right/image_raw", IMAGE);
    bag.message(right, 1, &image(1, WIDTH, HEIGHT, "mono8", WIDTH, &[1; PIXELS]));
    let bytes = bag.finish();
    let message = error_of(&bytes, None);
    assert!(
        message.contains("name one of /cam/image_raw, /right/image_raw, as mcap:FILE:TOPIC"),
        "{message}"
    );
    assert!(opened(&bytes, Some("/cam/image_raw")).1.is_ok());
    assert!(error_of(&bytes, Some("/right/image_raw")).contains("no CameraInfo"));
    assert!(error_of(&bytes, Some("/left")).contains("topics with images are /cam/image_raw,"));

    let mut bag = TestBag::default();
    bag.topic("/tf", "tf2_msgs/msg/TFMessage");
    assert!(error_of(&bag.finish(), None).contains("no topic with images"));
    assert!(error_of(b"no", None).contains("is not an MCAP file"));
    let mut bag = camera_bag(0);
    bag.topic("/more", IMAGE);
    assert!(error_of(&bag.finish(), Some("/more")).contains("has no images on `/more`"));
}

#[test]
fn arbitrary_sizes_are_errors_and_take_no_memory() {
    let whole = camera_bag(2).finish();
    // Every length field claims the largest number; whatever the outcome, reading ends.
    for at in (0..whole.len()).step_by(3) {
        for length in [4, 8] {
            let mut bytes = whole.clone();
            let end = (at + length).min(bytes.len());
            bytes[at..end].fill(0xff);
            let file = written(&bytes);
            if let Ok(mut bag) = open(&file.path, None, None) {
                assert!(bag.num_frames().unwrap() <= bytes.len());
                let _ = play(&mut bag);
            }
        }
    }
    // A chunk within a chunk is not followed.
    let mut bag = camera_bag(1);
    bag.chunk.extend(record(6, &[0; 40]));
    let (_file, bag) = opened(&bag.finish(), None);
    assert_eq!(play(&mut bag.unwrap()).0.len(), 1);
}

#[test]
fn names_of_bags_are_parsed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    std::fs::write(&path, camera_bag(1).finish()).unwrap();
    let bag = |topic: Option<&str>| SourceName::Mcap {
        file: path.clone(),
        topic: topic.map(str::to_owned),
    };
    let file = path.display();
    for (name, expected) in [
        (format!("mcap:{file}"), bag(None)),
        (format!("{file}"), bag(None)),
        (folder.path().display().to_string(), bag(None)),
        (format!("mcap:{}", folder.path().display()), bag(None)),
        (format!("mcap:{file}:/cam/image_raw"), bag(Some("/cam/image_raw"))),
    ] {
        let found: SourceName = name.parse().unwrap();
        assert_eq!(found, expected, "{name}");
        assert_eq!(SourceName::parse(&found.to_os_string()).unwrap(), found);
    }
    std::fs::write(folder.path().join("run_1.mcap"), "").unwrap();
    let error = format!("mcap:{}", folder.path().display()).parse::<SourceName>().unwrap_err();
    assert!(error.to_string().contains("2 .mcap files"), "{error}");
    assert!("mcap:".parse::<SourceName>().is_err());
}
