// semidense for C: poses, frames, keyframes and the graph of a running instance, from shared memory.
//
//     semidense_reader *reader = NULL;
//     if (semidense_open(NULL, NULL, SEMIDENSE_WANT_POSES, -1, &reader) != SEMIDENSE_STATUS_OK)
//         return fprintf(stderr, "%s\n", semidense_last_error()), 1;
//     semidense_pose pose;
//     while (semidense_wait(reader, -1) == SEMIDENSE_STATUS_OK)
//         while (semidense_next_pose(reader, &pose) == SEMIDENSE_STATUS_OK)
//             printf("%d %g\n", pose.state, pose.world_from_camera.translation[0]);
//     semidense_close(reader);
//
// A reader belongs to the thread that opened it. What lies in shared memory may be read until the function that gave it is
// called again. Frames: the camera looks along z, x is right and y is down; a_from_b takes points in b to a.
//
// Generated from the Rust definitions in c/src by cbindgen: never edit it.

#ifndef SEMIDENSE_H
#define SEMIDENSE_H

#include <stdint.h>

// What a reader reads: a sum of these.
#define SEMIDENSE_WANT_POSES 1u
#define SEMIDENSE_WANT_FRAMES 2u
#define SEMIDENSE_WANT_KEYFRAMES 4u
#define SEMIDENSE_WANT_GRAPH 8u
// The id of no keyframe: before the first.
#define SEMIDENSE_NO_KEYFRAME UINT64_MAX

// How a call ended: 0 and above are no errors.
typedef enum semidense_status {
  // Done.
  SEMIDENSE_STATUS_OK = 0,
  // Nothing new: everything has been read, or the time is over.
  SEMIDENSE_STATUS_NONE = 1,
  // The run has ended and everything has been read: close the reader.
  SEMIDENSE_STATUS_ENDED = 2,
  // A pointer is null or misaligned, a text is not UTF-8, or a number is out of range.
  SEMIDENSE_STATUS_ERROR_ARGUMENT = -1,
  // The reader is closed, or was opened by another thread.
  SEMIDENSE_STATUS_ERROR_HANDLE = -2,
  // No instance of this name runs here.
  SEMIDENSE_STATUS_ERROR_NOT_RUNNING = -3,
  // The instance speaks another wire version than this library.
  SEMIDENSE_STATUS_ERROR_WIRE_VERSION = -4,
  // Shared memory cannot be used: another user's, full, or a limit.
  SEMIDENSE_STATUS_ERROR_TRANSPORT = -5,
  // The reader was not opened for this kind of message.
  SEMIDENSE_STATUS_ERROR_NOT_WANTED = -6,
  // A fault of this library.
  SEMIDENSE_STATUS_ERROR_INTERNAL = -7,
} semidense_status;

// Tracking status of a frame.
typedef enum semidense_state {
  // No map that can be trusted yet; the pose is a working value.
  SEMIDENSE_STATE_INITIALIZING = 0,
  // The pose is good to its covariance.
  SEMIDENSE_STATE_TRACKING = 1,
  // The pose is usable, but worse than it should be: see the reason.
  SEMIDENSE_STATE_DEGRADED = 2,
  // The pose is not claimed: see the reason.
  SEMIDENSE_STATE_LOST = 3,
} semidense_state;

// Why a pose is degraded or lost.
typedef enum semidense_reason {
  // It is neither.
  SEMIDENSE_REASON_NONE = 0,
  // Degraded: the deadline came before the finest level was solved.
  SEMIDENSE_REASON_BUDGET = 1,
  // Degraded: few of the keyframe's points are in view.
  SEMIDENSE_REASON_LOW_OVERLAP = 2,
  // Degraded: the residuals are larger than noise and depth variance explain.
  SEMIDENSE_REASON_HIGH_RESIDUAL = 3,
  // Degraded: frames are missing between this one and the one before.
  SEMIDENSE_REASON_GAP = 4,
  // Degraded: the known depth is out of view; the rotation holds, the position stands still.
  SEMIDENSE_REASON_TURNING = 5,
  // Lost: the iteration left the image or became non-finite.
  SEMIDENSE_REASON_DIVERGED = 6,
  // Lost: too few of the points match.
  SEMIDENSE_REASON_TOO_FEW_INLIERS = 7,
  // Lost: the keyframe has no usable points.
  SEMIDENSE_REASON_NO_POINTS = 8,
  // Lost: the frame has another size than the keyframe, or no contrast at all.
  SEMIDENSE_REASON_UNUSABLE_FRAME = 9,
  // Lost: the mapper found the map inconsistent.
  SEMIDENSE_REASON_MAP_REJECTED = 10,
} semidense_reason;

// An open reader: closed by `semidense_close`, used by the thread that opened it alone.
typedef struct semidense_reader semidense_reader;

// `x' = scale · R x + t`; the scale of a rigid transform is 1.
typedef struct semidense_transform {
  // Rotation as a unit quaternion: x, y, z, w.
  double quaternion[4];
  // Translation.
  double translation[3];
  // Scale.
  double scale;
} semidense_transform;

// The pose of one frame; every frame has one, also when the camera is lost.
typedef struct semidense_pose {
  // Number of the frame at its source; a gap is a frame that is missing.
  uint64_t sequence;
  // Middle of the exposure, nanoseconds: CLOCK_MONOTONIC of a camera, else the recording's clock.
  int64_t capture_nanos;
  // CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 where unknown.
  int64_t realtime_nanos;
  // CLOCK_MONOTONIC when the pose was published.
  int64_t published_nanos;
  // From the frame to the publication of its pose.
  uint64_t latency_nanos;
  // Keyframe it was tracked on, all ones before the first.
  uint64_t keyframe_id;
  // Revision of that keyframe.
  uint64_t keyframe_revision;
  // How often the map had been corrected: `map_from_camera` may jump where it grows.
  uint64_t map_revision;
  // Life of the map.
  uint32_t epoch;
  // Tracking status.
  enum semidense_state state;
  // Why it is degraded or lost.
  enum semidense_reason reason;
  // 1 where the velocities are known, else 0.
  uint32_t has_velocity;
  // Odometry: never jumps within an epoch, and drifts.
  struct semidense_transform world_from_camera;
  // The best estimate in the map; jumps where the map is corrected.
  struct semidense_transform map_from_camera;
  // Relative to the keyframe, keyframe units.
  struct semidense_transform keyframe_from_camera;
  // 6×6, of the left increment (translation, rotation) of camera_from_keyframe, keyframe units and radians.
  double covariance[36];
  // 6×6, of the left increment (translation, rotation) of `map_from_camera`, map units and radians.
  double map_covariance[36];
  // Of the camera, in its own axes, world units a second.
  double linear_velocity[3];
  // Of the camera, in its own axes, radians a second.
  double angular_velocity[3];
  // 6×6, of (linear, angular) velocity.
  double velocity_covariance[36];
  // a, b of `I_camera ≈ eᵃ I_keyframe + b`, grey levels.
  double brightness[2];
  // Share of the keyframe's points in view, 0 to 1.
  double in_view_ratio;
  // Share of those compared that are explained, 0 to 1.
  double inlier_ratio;
  // Root mean square residual, grey levels.
  double residual_rmse;
} semidense_pose;

// A camera without distortion: images are rectified. Integer coordinates are the centres of pixels.
typedef struct semidense_intrinsics {
  // Horizontal focal length, pixels.
  double fx;
  // Vertical focal length, pixels.
  double fy;
  // Column of the principal point, pixels.
  double cx;
  // Row of the principal point, pixels.
  double cy;
} semidense_intrinsics;

// An image of the camera; its pixels lie in shared memory.
typedef struct semidense_frame {
  // Number of the frame at its source, as in its pose.
  uint64_t sequence;
  // Middle of the exposure, nanoseconds.
  int64_t capture_nanos;
  // CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 where unknown.
  int64_t realtime_nanos;
  // Exposure time, nanoseconds, 0 where unknown.
  uint64_t exposure_nanos;
  // Sensor gain, 0 where unknown.
  float gain;
  // Pixels in a row; rows follow each other without a gap.
  uint32_t width;
  // Rows.
  uint32_t height;
  // Of the rectified image.
  struct semidense_intrinsics intrinsics;
  // Grey, `width * height` bytes. Valid until the next `semidense_newest_frame` on this reader, or its end.
  const uint8_t *pixels;
} semidense_frame;

// One pixel with depth.
typedef struct semidense_depth_point {
  // Column of the pixel.
  uint16_t u;
  // Row of the pixel.
  uint16_t v;
  // 1/z along the optical axis, 1/keyframe units; 0 or less: infinitely far.
  float inverse_depth;
  // Variance of the inverse depth.
  float variance;
  // Brightness of the pixel, 0 to 255.
  float intensity;
} semidense_depth_point;

// A frame with depth; points and image lie in shared memory.
typedef struct semidense_keyframe {
  // Its id, as poses and graph name it.
  uint64_t keyframe_id;
  // Counts up with every change of the map: the same keyframe comes again with refined depth.
  uint64_t revision;
  // Number of its frame.
  uint64_t sequence;
  // Stamp of its frame, nanoseconds.
  int64_t capture_nanos;
  // How often the map had been corrected by then.
  uint64_t map_revision;
  // Life of the map.
  uint32_t epoch;
  // Pixels in a row of its image.
  uint32_t width;
  // Rows of its image.
  uint32_t height;
  // Points with depth.
  uint32_t num_points;
  // Of its image.
  struct semidense_intrinsics intrinsics;
  // Where odometry has it; the scale is its unit.
  struct semidense_transform world_from_keyframe;
  // Where the map has it; the scale is its unit.
  struct semidense_transform map_from_keyframe;
  // `num_points` of them. Valid until the next `semidense_newest_keyframe` on this reader, or its end.
  const struct semidense_depth_point *points;
  // Grey, `width * height` bytes. Valid for as long as `points`.
  const uint8_t *image;
} semidense_keyframe;

// Where the map has a keyframe.
typedef struct semidense_keyframe_pose {
  // The keyframe.
  uint64_t keyframe_id;
  // Revision of its depth.
  uint64_t revision;
  // Its place; the scale is its unit.
  struct semidense_transform map_from_keyframe;
} semidense_keyframe_pose;

// The poses of all keyframes in the map.
typedef struct semidense_graph {
  // Newest revision of a keyframe in it.
  uint64_t revision;
  // How often the map had been corrected.
  uint64_t map_revision;
  // Life of the map.
  uint32_t epoch;
  // Keyframes in it.
  uint32_t num_keyframes;
  // `num_keyframes` of them. Valid until the next `semidense_newest_graph` on this reader, or its end.
  const struct semidense_keyframe_pose *keyframes;
} semidense_graph;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Waits for an instance and joins it.
//
// `instance`: its name, null for "semidense". `root`: its folder, null for the usual one (SEMIDENSE_ROOT and so on).
// `wanted`: the sum of SEMIDENSE_WANT_… that are read. `timeout_ms`: how long to wait for it, -1 forever, 0 when it must
// be there now. `reader` gets the reader; it is null after an error.
//
// SEMIDENSE_STATUS_OK, or SEMIDENSE_STATUS_ERROR_NOT_RUNNING, …_WIRE_VERSION, …_TRANSPORT, …_ARGUMENT.
//
// # Safety
// Texts are null or end with a zero; `reader` is null or may be written to.
enum semidense_status semidense_open(const char *instance,
                                     const char *root,
                                     uint32_t wanted,
                                     int64_t timeout_ms,
                                     struct semidense_reader **reader);

// Leaves the instance. All that the reader has given is no longer valid. Null does nothing.
enum semidense_status semidense_close(struct semidense_reader *reader);

// A file descriptor for poll, select and epoll, or -1 after an error: when it is readable, call `semidense_wait` with a
// timeout of 0, then read until SEMIDENSE_STATUS_NONE. It belongs to the reader: do not read from it, do not close it.
int semidense_descriptor(const struct semidense_reader *reader);

// Waits for messages, `timeout_ms` at most (-1: forever).
//
// SEMIDENSE_STATUS_OK: there may be something to read; read each kind until SEMIDENSE_STATUS_NONE. SEMIDENSE_STATUS_NONE:
// the time is over. SEMIDENSE_STATUS_ENDED: the run is over and all has been read; close the reader, and open another for
// the next run.
enum semidense_status semidense_wait(struct semidense_reader *reader, int64_t timeout_ms);

// The oldest pose that has not been read: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. 900 are kept.
//
// # Safety
// `pose` is null or may be written to.
enum semidense_status semidense_next_pose(struct semidense_reader *reader, struct semidense_pose *pose);

// The newest frame, where it has not been read: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The one before is no longer valid,
// whatever the answer.
//
// # Safety
// `frame` is null or may be written to.
enum semidense_status semidense_newest_frame(struct semidense_reader *reader,
                                             struct semidense_frame *frame);

// The newest keyframe or revision of its depth, where it has not been read: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The
// one before is no longer valid, whatever the answer. A reader that comes late gets the active one.
//
// # Safety
// `keyframe` is null or may be written to.
enum semidense_status semidense_newest_keyframe(struct semidense_reader *reader, struct semidense_keyframe *keyframe);

// The poses of all keyframes, where they have changed: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The ones before are valid
// until the next SEMIDENSE_STATUS_OK.
//
// # Safety
// `graph` is null or may be written to.
enum semidense_status semidense_newest_graph(struct semidense_reader *reader,
                                             struct semidense_graph *graph);

// How many messages were left out because they are broken; 0 after an error.
uint64_t semidense_refused(const struct semidense_reader *reader);

// Writes a transform as a 4×4 matrix, row by row; its rotation is multiplied by the scale.
//
// # Safety
// `transform` is null or points to one; `matrix` is null or has room for 16 numbers.
enum semidense_status semidense_matrix(const struct semidense_transform *transform, double *matrix);

// Why the last call of this thread that failed did, in words: what, where, what to do. Never null; valid until the next
// failure of this thread.
const char *semidense_last_error(void);

// The version of this library, as in "0.1.0".
const char *semidense_version(void);

// The version of the messages that this library reads: that of the pipeline must be the same.
uint32_t semidense_wire_version(void);

// The name of a status, as in "SEMIDENSE_STATUS_OK".
const char *semidense_status_name(int status);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* SEMIDENSE_H */
