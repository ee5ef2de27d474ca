//! Pairs frames and poses by sequence.

use std::collections::VecDeque;

use crate::slam::pose::PoseEstimate;

/// Poses kept while their frame is missing: half a second at 60 Hz, far longer than a frame is late.
const MAX_POSES: usize = 32;

/// Frames and poses that wait for each other. `F` is a frame in shared memory.
#[derive(Debug)]
pub struct Pairing<F> {
    frames: VecDeque<(u64, F)>,
    poses: VecDeque<PoseEstimate>,
    max_frames: usize,
    dropped: u64,
}

impl<F> Pairing<F> {
    /// Keeps at most `max_frames` frames: they are borrowed from shared memory.
    pub fn new(max_frames: usize) -> Self {
        let (frames, poses) = (VecDeque::new(), VecDeque::new());
        Self { frames, poses, max_frames, dropped: 0 }
    }

    /// The source has restarted its numbering: drops everything that waits.
    pub fn restart(&mut self) {
        self.dropped += self.frames.len() as u64;
        self.frames.clear();
        self.poses.clear();
    }

    /// Adds a frame, later than all before; drops the oldest where there are too many.
    pub fn push_frame(&mut self, sequence: u64, frame: F) {
        if self.frames.len() == self.max_frames {
            self.frames.pop_front();
            self.dropped += 1;
        }
        self.frames.push_back((sequence, frame));
    }

    /// Adds a pose: in order or, from a tracker that has died, late or repeated.
    pub fn push_pose(&mut self, pose: PoseEstimate) {
        let place = self.poses.partition_point(|known| known.sequence < pose.sequence);
        if self.poses.get(place).is_some_and(|known| known.sequence == pose.sequence) {
            return;
        }
        self.poses.insert(place, pose);
        if self.poses.len() > MAX_POSES {
            self.poses.pop_front();
        }
    }

    /// Takes the oldest pair. Frames before it will get no pose and are dropped.
    pub fn take(&mut self) -> Option<(F, PoseEstimate)> {
        while let Some(pose) = self.poses.front() {
            let (oldest, _) = self.frames.front()?;
            let newest = self.frames.back().map_or(*oldest, |(sequence, _)| *sequence);
            if let Some(index) = self.frames.iter().position(|(s, _)| *s == pose.sequence) {
                self.frames.drain(..index);
                self.dropped += index as u64;
                let (_, frame) = self.frames.pop_front()?;
                return Some((frame, self.poses.pop_front()?));
            }
            if pose.sequence > newest {
                return None; // its frame is on the way
            }
            self.poses.pop_front();
        }
        None
    }

    /// Frames dropped without a pose since the start.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(sequence: u64) -> PoseEstimate {
        PoseEstimate::unknown_at(sequence, 0)
    }

    fn take(pairing: &mut Pairing<char>) -> Option<(char, u64)> {
        pairing.take().map(|(frame, pose)| (frame, pose.sequence))
    }

    #[test]
    fn either_may_arrive_first() {
        let mut pairing = Pairing::new(3);
        pairing.push_pose(pose(0));
        assert_eq!(take(&mut pairing), None);
        pairing.push_frame(0, 'a');
        assert_eq!(take(&mut pairing), Some(('a', 0)));
        pairing.push_frame(1, 'b');
        assert_eq!(take(&mut pairing), None);
        pairing.push_pose(pose(1));
        assert_eq!(take(&mut pairing), Some(('b', 1)));
        assert_eq!(pairing.dropped(), 0);
    }

    #[test]
    fn frames_the_tracker_skipped_are_dropped() {
        let mut pairing = Pairing::new(3);
        for (sequence, frame) in [(0, 'a'), (1, 'b'), (2, 'c')] {
            pairing.push_frame(sequence, frame);
        }
        pairing.push_pose(pose(2));
        assert_eq!(take(&mut pairing), Some(('c', 2)));
        assert_eq!(pairing.dropped(), 2);
    }

    #[test]
    fn a_pose_without_its_frame_does_not_block() {
        let mut pairing = Pairing::new(2);
        for (sequence, frame) in [(0, 'a'), (1, 'b'), (2, 'c')] {
            pairing.push_frame(sequence, frame);
        }
        for sequence in 0..=3 {
            pairing.push_pose(pose(sequence));
        }
        assert_eq!(take(&mut pairing), Some(('b', 1)));
        assert_eq!(take(&mut pairing), Some(('c', 2)));
        assert_eq!(take(&mut pairing), None, "frame 3 is on the way");
        pairing.push_frame(3, 'd');
        assert_eq!(take(&mut pairing), Some(('d', 3)));
    }

    #[test]
    fn a_restarted_source_does_not_block() {
        let mut pairing = Pairing::new(3);
        pairing.push_pose(pose(500));
        pairing.push_frame(501, 'x');
        pairing.restart();
        pairing.push_frame(0, 'a');
        pairing.push_pose(pose(0));
        assert_eq!(take(&mut pairing), Some(('a', 0)));
        assert_eq!(pairing.dropped(), 1);
    }

    #[test]
    fn late_and_repeated_poses_lose_no_pair() {
        let mut pairing = Pairing::new(3);
        for (sequence, frame) in [(4, 'a'), (5, 'b'), (6, 'c')] {
            pairing.push_frame(sequence, frame);
        }
        for sequence in [5, 6, 2, 4, 5] {
            pairing.push_pose(pose(sequence));
        }
        assert_eq!(take(&mut pairing), Some(('a', 4)));
        assert_eq!(take(&mut pairing), Some(('b', 5)));
        pairing.push_pose(pose(4));
        assert_eq!(take(&mut pairing), Some(('c', 6)));
        assert_eq!(pairing.dropped(), 0);
    }

    #[test]
    fn a_pose_whose_frame_never_arrives_does_not_block_earlier_ones() {
        let mut pairing = Pairing::new(3);
        pairing.push_pose(pose(u64::MAX));
        for sequence in 0..100 {
            pairing.push_frame(sequence, 'a');
            pairing.push_pose(pose(sequence));
            assert_eq!(take(&mut pairing), Some(('a', sequence)));
        }
    }
}
