//! Inverse depth by small-baseline stereo, and the filters that keep it (Engel, Sturm, Cremers 2013).
