//! Names the shared library after the version of its interface, and hides all symbols that are not part of it.

/// Incremented when a function or structure of the header changes; the Debian package is named after it.
const INTERFACE_VERSION: u32 = 0;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // Only our own functions are exported: rustc's version script also exports the unmangled symbols of
    // dependencies, and a second script can only add to it.
    println!("cargo::rustc-cdylib-link-arg=-Wl,--exclude-libs,ALL");
    println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libsemidense.so.{INTERFACE_VERSION}");
}
