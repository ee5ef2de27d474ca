//! `semidense-bridge view`: the live page.

use std::net::SocketAddr;

use clap::Args;

use crate::command::{CommandResult, CommonArguments};

/// Serve a live web page: camera, map, state, latencies; `/metrics` for Prometheus
#[derive(Debug, Args)]
pub struct ViewArguments {
    /// Address and port to serve on; beyond this machine only with an address of it
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8765")]
    listen: SocketAddr,
}

/// Runs it until a signal comes.
pub fn run(common: &CommonArguments, arguments: &ViewArguments) -> CommandResult {
    common.place()?;
    Err(format!("{}: there is no page yet", arguments.listen).into())
}
