//! Folders through which the processes of an instance find each other.

/// The root folder under systemd, the same for every unit.
pub const SYSTEM_ROOT: &str = "/run/semidense";

/// Environment variable that names the root folder.
pub const ROOT_VARIABLE: &str = "SEMIDENSE_ROOT";

/// Where the kernel keeps shared memory.
pub const SHARED_MEMORY: &str = "/dev/shm";

/// Longest root folder: a listener's socket lies in it, and the path of a socket is limited to 107 bytes.
pub(in crate::wire) const MAX_ROOT_BYTES: usize = 48;
