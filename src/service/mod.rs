//! Process shells: clock, threads, scheduling, configuration, health, results; one loop a process.
