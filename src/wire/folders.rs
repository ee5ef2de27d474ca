//! The folders by which the processes of an instance find each other.

/// The folder under systemd, where every unit has the same one.
pub const SYSTEM_ROOT: &str = "/run/semidense";

/// Environment variable that names the folder.
pub const ROOT_VARIABLE: &str = "SEMIDENSE_ROOT";

/// Where the kernel keeps shared memory.
pub const SHARED_MEMORY: &str = "/dev/shm";

/// Longest folder: the socket of a listener lies in it, and a socket's path has at most 107 bytes.
pub(in crate::wire) const MAX_ROOT_BYTES: usize = 48;
