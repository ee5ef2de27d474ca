//! Whether the map was thinned until nothing was left.

use crate::slam::fusion::MapResolution;

/// A warning where a resolution too coarse for the scene left none of the keyframes' points in the map. With the default
/// resolution, an empty map has other causes.
pub fn empty_map_warning(
    points: usize,
    map_points: usize,
    resolution: MapResolution,
) -> Option<String> {
    let is_coarse = match (resolution, MapResolution::default()) {
        (MapResolution::Relative(share), MapResolution::Relative(usual)) => share > usual,
        (resolution, usual) => resolution != usual,
    };
    (points > 0 && map_points == 0 && is_coarse).then(|| {
        format!(
            "map.ply is empty: the map resolution {resolution} is too coarse for this scene; give a smaller one \
             (--map-resolution, results.map_resolution), such as {}",
            MapResolution::default()
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_map_that_was_thinned_away_gives_a_warning() {
        let coarse = MapResolution::Length(5.0);
        let empty = empty_map_warning(900, 0, coarse).unwrap();
        assert!(empty.contains("resolution 5 is") && empty.ends_with("such as 0.5%"), "{empty}");
        assert_eq!(empty_map_warning(900, 1, coarse), None);
        assert_eq!(empty_map_warning(0, 0, coarse), None);
        assert_eq!(empty_map_warning(900, 0, MapResolution::default()), None);
        assert!(empty_map_warning(900, 0, MapResolution::Relative(0.1)).is_some());
        assert_eq!(empty_map_warning(900, 0, MapResolution::Relative(0.001)), None);
    }
}
