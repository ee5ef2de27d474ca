//! Variance-normalised direct image alignment on SE(3) (Engel, Schöps, Cremers 2014, §3.3).

pub mod reference;
