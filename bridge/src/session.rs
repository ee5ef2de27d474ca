//! The reader of an instance's topics, which every output starts from.

pub use semidense::reader::{Event, Frame, Graph, Pose, Session, SessionError, Wants};
