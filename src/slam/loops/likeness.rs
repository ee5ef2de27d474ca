//! Which keyframes look like one, wherever they are thought to be.

use crate::slam::mapper::appearance::Appearance;

/// What keyframes look like.
#[derive(Debug, Clone, Default)]
pub(super) struct Likeness {
    /// By id, in order.
    appearances: Vec<(u64, Appearance)>,
}

impl Likeness {
    /// Enters a keyframe; one whose image is too small to look like anything is left out.
    pub(super) fn insert(&mut self, keyframe_id: u64, pixels: &[u8], width: usize, height: usize) {
        let Some(appearance) = Appearance::of(pixels, width, height) else { return };
        match self.appearances.binary_search_by_key(&keyframe_id, |(id, _)| *id) {
            Ok(place) => self.appearances[place].1 = appearance,
            Err(place) => self.appearances.insert(place, (keyframe_id, appearance)),
        }
    }

    fn get(&self, keyframe_id: u64) -> Option<&Appearance> {
        let place = self.appearances.binary_search_by_key(&keyframe_id, |(id, _)| *id).ok()?;
        self.appearances.get(place).map(|(_, appearance)| appearance)
    }

    /// Of `among` those that look most like a keyframe, at least so much, the most alike first; no two beside each other in
    /// `among`, which would show the same.
    pub(super) fn candidates(&self, of: u64, among: &[u64], most: usize, least: f32) -> Vec<u64> {
        /// Places in the list within which two show the same.
        const BESIDE: usize = 3;
        let Some(here) = self.get(of) else { return Vec::new() };
        let of_place = |(place, id): (usize, &u64)| {
            let likeness = self.get(*id)?.similarity(here);
            (likeness >= least).then_some((likeness, place))
        };
        let mut alike: Vec<(f32, usize)> = among.iter().enumerate().filter_map(of_place).collect();
        alike.sort_by(|one, other| other.0.total_cmp(&one.0).then(one.1.cmp(&other.1)));
        let mut chosen: Vec<usize> = Vec::new();
        for (_, place) in alike {
            if chosen.len() < most && chosen.iter().all(|other| other.abs_diff(place) > BESIDE) {
                chosen.push(place);
            }
        }
        chosen.into_iter().map(|place| among[place]).collect()
    }
}
