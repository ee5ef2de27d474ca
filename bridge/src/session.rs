//! The reader of an instance's topics, on which every output is built.

pub use semidense::reader::{Event, Frame, Graph, Pose, Session, SessionError, Wants};
