//! Shared memory: the only place that names iceoryx2.
