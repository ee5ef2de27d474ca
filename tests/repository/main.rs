//! The repository itself: its structure, pages, packages and licences.

mod architecture;
mod command_line_page;
mod dependencies;
mod deployment;
mod docs_links;
mod wire_table;
