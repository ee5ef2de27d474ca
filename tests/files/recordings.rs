//! The readers on recordings of real cameras, if these are on the machine.

use crate::recording::recording;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::source_name::SourceName;

#[test]
fn every_recording_is_read_completely() {
    let params = SourceParams::default();
    for (name, frames, poses, depths) in [
        ("redkitchen", 500, 503, 125),
        ("fr1-floor", 90, 316, 90),
        ("icl-office3", 75, 75, 75),
        ("tsukuba", 150, 150, 0),
    ] {
        let Some(folder) = recording(name) else { continue };
        let mut source = open(&SourceName::Tum(folder), None, &params).expect(name);
        assert_eq!(source.num_frames(), Some(frames), "{name}");
        assert_eq!(source.ground_truth().len(), poses, "{name}");
        let k = source.intrinsics();
        let mut pixels = vec![0; k.width * k.height];
        let (mut read, mut with_depth, mut before) = (0, 0, i64::MIN);
        while let Some(stamp) = source.next_into(&mut pixels).expect(name) {
            assert_eq!(stamp.sequence, read);
            assert!(stamp.capture_nanos > before);
            before = stamp.capture_nanos;
            let mean = pixels.iter().map(|&p| f64::from(p)).sum::<f64>() / pixels.len() as f64;
            assert!((10.0..245.0).contains(&mean), "{name} frame {read}: mean grey {mean}");
            if read % 20 == 0 {
                let depth = source.depth_at(stamp.capture_nanos).expect(name);
                with_depth += usize::from(depth.is_some());
                if let Some(depth) = depth {
                    let known = depth.pixels().iter().filter(|&&z| z > 0.0).count();
                    assert!(known * 2 > depth.pixels().len(), "{name}: {known} pixels with depth");
                }
            }
            read += 1;
        }
        assert_eq!(read as usize, frames, "{name}");
        assert_eq!(with_depth > 0, depths > 0, "{name}");
    }
}
