//! Images of a recording that could not be used: left out, counted and named.

use crate::capture::source_error::SourceError;

/// Images that are named; beyond that only their number is reported.
const MAX_NAMED: usize = 10;

/// The images that a run leaves out.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RefusedImages {
    count: u64,
    /// The first of them: which image, and why.
    reasons: Vec<String>,
    /// Reasons logged so far.
    logged: usize,
    has_good_image: bool,
}

impl RefusedImages {
    /// Counts an image left out for this reason. It is logged once a good one has shown that the recording as a whole
    /// is usable; without a good one, the reason becomes the error.
    pub fn refuse(&mut self, error: &SourceError) {
        self.count += 1;
        if self.reasons.len() < MAX_NAMED {
            self.reasons.push(error.to_string());
        }
        self.log();
    }

    /// Notes a good image; returns whether it is the first.
    pub fn accept(&mut self) -> bool {
        let is_first = !self.has_good_image;
        if is_first {
            self.has_good_image = true;
            self.log();
        }
        is_first
    }

    fn log(&mut self) {
        if !self.has_good_image {
            return;
        }
        for reason in &self.reasons[self.logged..] {
            tracing::warn!("left out: {reason}");
            self.logged += 1;
            if self.logged == MAX_NAMED {
                tracing::warn!("further images left out are only counted");
            }
        }
    }

    /// How many were left out.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The error of a source that ended without one good image; `None` where there was one, or nothing was left out.
    pub fn error(&self) -> Option<SourceError> {
        let first = self.reasons.first().filter(|_| !self.has_good_image)?;
        Some(SourceError::AllDamaged { count: self.count, first: first.clone() })
    }

    /// A short text on the images left out; `None` where none were.
    pub fn text(&self) -> Option<String> {
        let first = self.reasons.first()?;
        Some(format!("{} left out, the first: {first}", self.count))
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::capture::decode_error::DecodeError;
    use crate::capture::image_file::ImageFileError;

    fn empty(name: usize) -> SourceError {
        let path = PathBuf::from(format!("{name}.png"));
        ImageFileError::Decode { path, source: DecodeError::Empty }.into()
    }

    #[test]
    fn all_are_counted_and_the_first_are_named() {
        let mut refused = RefusedImages::default();
        assert_eq!((refused.text(), refused.error().is_none()), (None, true));
        for name in 0..25 {
            refused.refuse(&empty(name));
        }
        assert_eq!((refused.count(), refused.reasons.len(), refused.logged), (25, 10, 0));
        let error = refused.error().unwrap().to_string();
        assert!(error.contains("25") && error.contains("0.png is empty"), "{error}");
        refused.accept();
        assert_eq!(refused.logged, 10);
        assert!(refused.error().is_none());
        assert!(refused.text().unwrap().starts_with("25 left out, the first: 0.png is empty"));
    }
}
