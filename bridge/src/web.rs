//! The live page and what else is served on its port: `/metrics`, the Foxglove WebSocket.
//!
//! [`server`] takes connections and looks at their head ([`http`], [`guard`]); [`scene`] is what a page shows, kept up to
//! date from the feed; [`stream`] sends it to one page; [`finished`] shows a run that is over.

pub mod finished;
pub mod guard;
pub mod history;
pub mod http;
pub mod metrics;
pub mod packing;
pub mod path;
pub mod saving;
pub mod scene;
pub mod seats;
pub mod server;
pub mod stream;
pub mod words;
