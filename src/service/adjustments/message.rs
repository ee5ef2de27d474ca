//! Records of joint estimates as messages of `mapper/adjustment`.

use crate::service::adjustments::{AdjustmentRecord, Fate};
use crate::slam::window::Adjustment;
use crate::wire::conversion::MessageError;
use crate::wire::message::AdjustmentMessage;

impl Fate {
    const ALL: [Self; 3] = [Self::Entered, Self::Merged, Self::Dropped];
}

/// The message of a record.
pub fn adjustment_message(record: &AdjustmentRecord) -> AdjustmentMessage {
    let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
    let Adjustment { keyframe_id, inlier_ratio, rms_grey, iterations, .. } = record.adjustment;
    AdjustmentMessage {
        sequence: record.sequence,
        frames: record.frames,
        cpu_nanos: record.nanos,
        keyframe_id,
        inlier_ratio,
        rms_grey,
        fate: record.fate as u32,
        free: count(record.adjustment.free),
        fixed: count(record.adjustment.fixed),
        points: count(record.adjustment.points),
        comparisons: count(record.adjustment.comparisons),
        iterations,
    }
}

/// The record of a message, checked.
pub fn adjustment_from_message(
    message: &AdjustmentMessage,
) -> Result<AdjustmentRecord, MessageError> {
    let AdjustmentMessage { keyframe_id, inlier_ratio, rms_grey, iterations, .. } = *message;
    if !(inlier_ratio.is_finite() && rms_grey.is_finite()) {
        return Err(MessageError::InvalidNumber { field: "rms_grey" });
    }
    let code = message.fate;
    let unknown = MessageError::UnknownCode { field: "fate", code };
    Ok(AdjustmentRecord {
        sequence: message.sequence,
        frames: message.frames,
        nanos: message.cpu_nanos,
        fate: *Fate::ALL.get(code as usize).ok_or(unknown)?,
        adjustment: Adjustment {
            keyframe_id,
            free: message.free as usize,
            fixed: message.fixed as usize,
            points: message.points as usize,
            comparisons: message.comparisons as usize,
            inlier_ratio,
            rms_grey,
            iterations,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_survives_its_message_and_an_invalid_message_is_refused() {
        for fate in Fate::ALL {
            let record = AdjustmentRecord {
                sequence: 1,
                frames: 2,
                nanos: 3,
                fate,
                adjustment: Adjustment {
                    keyframe_id: 4,
                    free: 5,
                    fixed: 6,
                    points: 7,
                    comparisons: 8,
                    inlier_ratio: 0.9,
                    rms_grey: 1.0,
                    iterations: 11,
                },
            };
            assert_eq!(adjustment_from_message(&adjustment_message(&record)).unwrap(), record);
        }
        let good = AdjustmentMessage::default();
        let nan = AdjustmentMessage { rms_grey: f64::NAN, ..good };
        let infinite = AdjustmentMessage { inlier_ratio: f64::INFINITY, ..good };
        let fate = AdjustmentMessage { fate: 3, ..good };
        assert!([nan, infinite, fate].iter().all(|bad| adjustment_from_message(bad).is_err()));
    }
}
