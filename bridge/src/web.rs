//! The live page and everything else served on its port: `/metrics`, the Foxglove WebSocket.
//!
//! [`server`] accepts connections and checks their head ([`http`], [`guard`]); [`scene`] holds what a page
//! shows, updated from the feed; [`stream`] sends it to one page; [`finished`] shows a finished run.

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
