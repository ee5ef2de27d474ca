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

// Outcome of a call: 0 and above are not errors.
typedef enum semidense_status {
  // Done.
  SEMIDENSE_STATUS_OK = 0,
  // Nothing new: everything has been read, or the timeout has passed.
  SEMIDENSE_STATUS_NONE = 1,
  // The run has ended and everything has been read: close the reader.
  SEMIDENSE_STATUS_ENDED = 2,
  // A pointer is null or misaligned, a text is not UTF-8, or a number is out of range.
  SEMIDENSE_STATUS_ERROR_ARGUMENT = -1,
  // The reader is closed, or was opened by another thread.
  SEMIDENSE_STATUS_ERROR_HANDLE = -2,
  // No instance of this name is running here.
  SEMIDENSE_STATUS_ERROR_NOT_RUNNING = -3,
  // The instance uses another wire version than this library.
  SEMIDENSE_STATUS_ERROR_WIRE_VERSION = -4,
  // Shared memory cannot be used: it belongs to another user, is full, or a limit is reached.
  SEMIDENSE_STATUS_ERROR_TRANSPORT = -5,
  // The reader was not opened for this kind of message.
  SEMIDENSE_STATUS_ERROR_NOT_WANTED = -6,
  // A defect of this library.
  SEMIDENSE_STATUS_ERROR_INTERNAL = -7,
} semidense_status;

// Tracking status of a frame.
typedef enum semidense_state {
  // There is no reliable map and no pose yet: do not use it.
  SEMIDENSE_STATE_INITIALIZING = 0,
  // The pose is accurate to its covariance.
  SEMIDENSE_STATE_TRACKING = 1,
  // The pose is usable, but less accurate than usual: see the reason.
  SEMIDENSE_STATE_DEGRADED = 2,
  // The pose is not claimed: see the reason.
  SEMIDENSE_STATE_LOST = 3,
} semidense_state;

// Why a pose is degraded or lost.
typedef enum semidense_reason {
  // Neither degraded nor lost.
  SEMIDENSE_REASON_NONE = 0,
  // Degraded: the deadline passed before the finest level was solved.
  SEMIDENSE_REASON_BUDGET = 1,
  // Degraded: few of the keyframe's points are in view.
  SEMIDENSE_REASON_LOW_OVERLAP = 2,
  // Degraded: the residuals are larger than noise and depth variance explain.
  SEMIDENSE_REASON_HIGH_RESIDUAL = 3,
  // Degraded: frames are missing between this one and the previous one.
  SEMIDENSE_REASON_GAP = 4,
  // Degraded: the known depth is out of view; the rotation is valid, the position is held.
  SEMIDENSE_REASON_TURNING = 5,
  // Lost: the iteration left the image or became non-finite.
  SEMIDENSE_REASON_DIVERGED = 6,
  // Lost: too few of the points match.
  SEMIDENSE_REASON_TOO_FEW_INLIERS = 7,
  // Lost: the keyframe has no usable points.
  SEMIDENSE_REASON_NO_POINTS = 8,
  // Lost: the frame differs in size from the keyframe, or has no contrast at all.
  SEMIDENSE_REASON_UNUSABLE_FRAME = 9,
  // Lost: the mapper found the map inconsistent.
  SEMIDENSE_REASON_MAP_REJECTED = 10,
} semidense_reason;

// An open reader: closed by `semidense_close`, used only by the thread that opened it.
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

// The pose of one frame; every frame has one, even when the camera is lost.
typedef struct semidense_pose {
  // Number of the frame at its source; a gap is a missing frame.
  uint64_t sequence;
  // Middle of the exposure, nanoseconds: CLOCK_MONOTONIC of a camera, else the recording's clock.
  int64_t capture_nanos;
  // CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 if unknown.
  int64_t realtime_nanos;
  // CLOCK_MONOTONIC when the pose was published.
  int64_t published_nanos;
  // Time from the frame to the publication of its pose.
  uint64_t latency_nanos;
  // Keyframe it was tracked on; all ones before the first.
  uint64_t keyframe_id;
  // Revision of that keyframe.
  uint64_t keyframe_revision;
  // Number of corrections of the map: `map_from_camera` may jump when it increases.
  uint64_t map_revision;
  // Epoch of the map.
  uint32_t epoch;
  // Tracking status.
  enum semidense_state state;
  // Why it is degraded or lost.
  enum semidense_reason reason;
  // 1 if the velocities are known, else 0.
  uint32_t has_velocity;
  // Odometry: never jumps within an epoch, but drifts.
  struct semidense_transform world_from_camera;
  // The best estimate in the map; jumps when the map is corrected.
  struct semidense_transform map_from_camera;
  // Relative to the keyframe, keyframe units.
  struct semidense_transform keyframe_from_camera;
  // 6×6 covariance of the left increment (translation, rotation) of camera_from_keyframe, keyframe units and rad.
  double covariance[36];
  // 6×6 covariance of the left increment (translation, rotation) of `map_from_camera`, map units and rad.
  double map_covariance[36];
  // Linear velocity of the camera in its own axes, world units per second.
  double linear_velocity[3];
  // Angular velocity of the camera in its own axes, radians per second.
  double angular_velocity[3];
  // 6×6 covariance of the velocity (linear, angular).
  double velocity_covariance[36];
  // a, b of `I_camera ≈ eᵃ I_keyframe + b`, grey levels.
  double brightness[2];
  // Share of the keyframe's points in view, 0 to 1.
  double in_view_ratio;
  // Share of the compared points that are inliers, 0 to 1.
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

// An image of the camera; its pixels are in shared memory.
typedef struct semidense_frame {
  // Number of the frame at its source, as in its pose.
  uint64_t sequence;
  // Middle of the exposure, nanoseconds.
  int64_t capture_nanos;
  // CLOCK_REALTIME of the frame, nanoseconds since 1970; 0 if unknown.
  int64_t realtime_nanos;
  // Exposure time, nanoseconds, 0 if unknown.
  uint64_t exposure_nanos;
  // Sensor gain, 0 if unknown.
  float gain;
  // Pixels in a row; rows are contiguous.
  uint32_t width;
  // Rows.
  uint32_t height;
  // Intrinsics of the rectified image.
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

// A frame with depth; points and image are in shared memory.
typedef struct semidense_keyframe {
  // Its id, as in poses and the graph.
  uint64_t keyframe_id;
  // Incremented with every change of the map: the same keyframe is sent again with refined depth.
  uint64_t revision;
  // Number of its frame.
  uint64_t sequence;
  // Stamp of its frame, nanoseconds.
  int64_t capture_nanos;
  // Number of corrections of the map by then.
  uint64_t map_revision;
  // Epoch of the map.
  uint32_t epoch;
  // Pixels in a row of its image.
  uint32_t width;
  // Rows of its image.
  uint32_t height;
  // Points with depth.
  uint32_t num_points;
  // Intrinsics of its image.
  struct semidense_intrinsics intrinsics;
  // Pose in the odometry world; the scale is its unit.
  struct semidense_transform world_from_keyframe;
  // Pose in the map; the scale is its unit.
  struct semidense_transform map_from_keyframe;
  // Array of `num_points`. Valid until the next `semidense_newest_keyframe` on this reader, or its end.
  const struct semidense_depth_point *points;
  // Grey, `width * height` bytes. Valid for as long as `points`.
  const uint8_t *image;
} semidense_keyframe;

// The pose of a keyframe in the map.
typedef struct semidense_keyframe_pose {
  // The keyframe.
  uint64_t keyframe_id;
  // Revision of its depth.
  uint64_t revision;
  // Pose in the map; the scale is its unit.
  struct semidense_transform map_from_keyframe;
} semidense_keyframe_pose;

// The poses of all keyframes in the map.
typedef struct semidense_graph {
  // Newest revision of a keyframe in the graph.
  uint64_t revision;
  // Number of corrections of the map.
  uint64_t map_revision;
  // Epoch of the map.
  uint32_t epoch;
  // Number of keyframes.
  uint32_t num_keyframes;
  // Array of `num_keyframes`. Valid until the next `semidense_newest_graph` on this reader, or its end.
  const struct semidense_keyframe_pose *keyframes;
} semidense_graph;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Waits for an instance and joins it.
//
// `instance`: its name, null for "semidense". `root`: its folder, null for the default (SEMIDENSE_ROOT and so on).
// `wanted`: the sum of the SEMIDENSE_WANT_… to read. `timeout_ms`: how long to wait for the instance, -1 forever, 0
// if it must be running already. `reader` receives the reader; it is null after an error.
//
// Returns SEMIDENSE_STATUS_OK, or SEMIDENSE_STATUS_ERROR_NOT_RUNNING, …_WIRE_VERSION, …_TRANSPORT, …_ARGUMENT.
//
// # Safety
// Texts are null or zero-terminated; `reader` is null or valid for writes.
enum semidense_status semidense_open(const char *instance,
                                     const char *root,
                                     uint32_t wanted,
                                     int64_t timeout_ms,
                                     struct semidense_reader **reader);

// Leaves the instance and invalidates everything the reader has returned. Does nothing for null.
enum semidense_status semidense_close(struct semidense_reader *reader);

// A file descriptor for poll, select and epoll, or -1 after an error: when it is readable, call `semidense_wait` with
// a timeout of 0, then read until SEMIDENSE_STATUS_NONE. It belongs to the reader: do not read from it or close it.
int semidense_descriptor(const struct semidense_reader *reader);

// Waits for messages for at most `timeout_ms` (-1: forever).
//
// Returns SEMIDENSE_STATUS_OK if there may be something to read: read each kind until SEMIDENSE_STATUS_NONE;
// SEMIDENSE_STATUS_NONE after the timeout; SEMIDENSE_STATUS_ENDED once the run is over and everything has
// been read: close the reader, and open another for the next run.
enum semidense_status semidense_wait(struct semidense_reader *reader, int64_t timeout_ms);

// Reads the oldest unread pose: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. 900 are kept.
//
// # Safety
// `pose` is null or valid for writes.
enum semidense_status semidense_next_pose(struct semidense_reader *reader, struct semidense_pose *pose);

// Reads the newest frame, if unread: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The previous frame becomes
// invalid, whatever is returned.
//
// # Safety
// `frame` is null or valid for writes.
enum semidense_status semidense_newest_frame(struct semidense_reader *reader, struct semidense_frame *frame);

// Reads the newest keyframe or revision of its depth, if unread: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The
// previous one becomes invalid, whatever is returned. A late reader receives the active keyframe.
//
// # Safety
// `keyframe` is null or valid for writes.
enum semidense_status semidense_newest_keyframe(struct semidense_reader *reader, struct semidense_keyframe *keyframe);

// Reads the poses of all keyframes, if they have changed: SEMIDENSE_STATUS_OK, …_NONE or …_ENDED. The
// previous ones are valid until the next SEMIDENSE_STATUS_OK.
//
// # Safety
// `graph` is null or valid for writes.
enum semidense_status semidense_newest_graph(struct semidense_reader *reader, struct semidense_graph *graph);

// Number of messages refused because they are malformed; 0 after an error.
uint64_t semidense_refused(const struct semidense_reader *reader);

// Writes a transform as a 4×4 matrix, row by row; its rotation is multiplied by the scale.
//
// # Safety
// `transform` is null or points to one; `matrix` is null or has room for 16 numbers.
enum semidense_status semidense_matrix(const struct semidense_transform *transform, double *matrix);

// Describes the last failed call of this thread: what, where, what to do. Never null; valid until the
// thread's next failure.
const char *semidense_last_error(void);

// The version of this library, as in "0.1.0".
const char *semidense_version(void);

// The version of the messages that this library reads; it must equal that of the pipeline.
uint32_t semidense_wire_version(void);

// The name of a status, as in "SEMIDENSE_STATUS_OK".
const char *semidense_status_name(int status);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* SEMIDENSE_H */
