//! `semidense doctor`: checks this machine for anything that will cost latency or fail.

use std::process::ExitCode;

use clap::Args;

use crate::command::CommandResult;
use crate::command::print::print_as;
use crate::service::config::Config;
use crate::service::doctor::{Finding, Machine, Severity, examine};

/// Check this machine for anything that will cost latency or fail, and suggest fixes
///
/// Checks limits, CPU governor, real-time throttling, clock source, shared memory, permissions and cameras.
/// Exits with 1 if something will not work.
#[derive(Debug, Args)]
pub struct DoctorArguments {
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

/// Prints the findings.
pub fn run(config: &Config, arguments: DoctorArguments) -> CommandResult {
    let findings = examine(&Machine::default(), config);
    print_as(arguments.json, &findings, |findings| findings.iter().map(line).collect())?;
    let is_broken = findings.iter().any(|finding| finding.severity == Severity::Error);
    Ok(if is_broken { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

fn line(finding: &Finding) -> String {
    let severity = match finding.severity {
        Severity::Ok => "ok",
        Severity::Warning => "warning",
        Severity::Error => "ERROR",
    };
    let remedy = match finding.remedy.is_empty() {
        true => String::new(),
        false => format!("{:31} fix: {}\n", "", finding.remedy),
    };
    format!("{severity:8} {:21} {}\n{remedy}", finding.subject, finding.found)
}
