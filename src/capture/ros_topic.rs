//! Which topics belong together, by the conventions of ROS.

/// The topic of the camera that belongs to images on `topic`: by ROS convention `camera_info` next to it.
pub fn camera_topic(topic: &str) -> String {
    beside(topic, "camera_info")
}

/// The topic of our own recording's stamps for images on `topic`.
pub fn frame_record_topic(topic: &str) -> String {
    beside(topic, "details/frame")
}

fn beside(topic: &str, name: &str) -> String {
    let namespace = base_topic(topic).rsplit_once('/').map_or("", |(namespace, _)| namespace);
    format!("{namespace}/{name}")
}

/// Whether the images on `topic` are already rectified, judging by its name (`image_rect`, `image_rect_color`).
pub fn is_rectified(topic: &str) -> bool {
    base_topic(topic).rsplit('/').next().is_some_and(|name| name.contains("rect"))
}

/// The topic without the name that `image_transport` adds.
fn base_topic(topic: &str) -> &str {
    topic.strip_suffix("/compressed").unwrap_or(topic)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_camera_info_is_next_to_its_images() {
        assert_eq!(camera_topic("/camera/image_raw"), "/camera/camera_info");
        assert_eq!(camera_topic("/a/b/image_rect/compressed"), "/a/b/camera_info");
        assert_eq!(camera_topic("/image"), "/camera_info");
        assert!(is_rectified("/a/image_rect/compressed") && !is_rectified("/rect/image_raw"));
    }
}
