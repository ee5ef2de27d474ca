// semidense for C++17: a thin layer over semidense.h that closes what it opens and throws what fails.
//
//     semidense::reader reader(SEMIDENSE_WANT_POSES);
//     while (reader.wait())
//         while (auto pose = reader.next_pose())
//             std::cout << pose->state << " " << pose->world_from_camera.translation[0] << "\n";
//
// A reader belongs to the thread that opened it.
#ifndef SEMIDENSE_HPP
#define SEMIDENSE_HPP

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "semidense.h"

namespace semidense {

// A call that failed: what, where, what to do.
class error : public std::runtime_error {
public:
    error(semidense_status status, const std::string &message) : std::runtime_error(message), status_(status) {}

    semidense_status status() const noexcept { return status_; }

private:
    semidense_status status_;
};

// Elements that lie somewhere else.
template <typename T> class view {
public:
    view(const T *data, std::size_t size) noexcept : data_(data), size_(size) {}

    const T *data() const noexcept { return data_; }
    std::size_t size() const noexcept { return size_; }
    bool empty() const noexcept { return size_ == 0; }
    const T *begin() const noexcept { return data_; }
    const T *end() const noexcept { return data_ + size_; }
    const T &operator[](std::size_t index) const noexcept { return data_[index]; }
    std::vector<T> copy() const { return std::vector<T>(begin(), end()); }

private:
    const T *data_;
    std::size_t size_;
};

using pose = semidense_pose;

// An image of the camera. `image()` may be read until the next `newest_frame` of its reader.
struct frame : semidense_frame {
    view<std::uint8_t> image() const noexcept { return {pixels, std::size_t{width} * height}; }
};

// A frame with depth. Points and pixels may be read until the next `newest_keyframe` of its reader.
struct keyframe : semidense_keyframe {
    view<semidense_depth_point> depth() const noexcept { return {points, num_points}; }
    view<std::uint8_t> pixels() const noexcept { return {image, std::size_t{width} * height}; }
};

// The poses of all keyframes. They may be read until the next `newest_graph` of its reader.
struct graph : semidense_graph {
    view<semidense_keyframe_pose> poses() const noexcept { return {keyframes, num_keyframes}; }
};

// A transform as a 4×4 matrix, row by row.
inline std::array<double, 16> matrix(const semidense_transform &transform) {
    std::array<double, 16> values{};
    const semidense_status status = semidense_matrix(&transform, values.data());
    if (status < 0) {
        throw error(status, semidense_last_error());
    }
    return values;
}

// Which instance, and how long to wait for it.
struct options {
    std::string instance = "semidense";
    // Empty for the usual folder (SEMIDENSE_ROOT and so on).
    std::string root;
    // Negative: forever.
    std::chrono::milliseconds timeout{-1};
};

// Reads one run of an instance.
class reader {
public:
    explicit reader(std::uint32_t wanted, const options &where = options()) {
        check(semidense_open(where.instance.c_str(), where.root.c_str(), wanted, where.timeout.count(), &reader_));
    }

    reader(const reader &) = delete;
    reader &operator=(const reader &) = delete;
    reader(reader &&other) noexcept : reader_(std::exchange(other.reader_, nullptr)) {}

    reader &operator=(reader &&other) noexcept {
        if (this != &other) {
            semidense_close(reader_);
            reader_ = std::exchange(other.reader_, nullptr);
        }
        return *this;
    }

    ~reader() { semidense_close(reader_); }

    // Waits for messages, `timeout` at most (negative: forever); false when the run is over and all has been read.
    bool wait(std::chrono::milliseconds timeout = std::chrono::milliseconds(-1)) {
        return check(semidense_wait(reader_, timeout.count())) != SEMIDENSE_STATUS_ENDED;
    }

    // For poll, select and epoll: when it is readable, `wait(0ms)` and read.
    int descriptor() const {
        const int descriptor = semidense_descriptor(reader_);
        if (descriptor < 0) {
            throw error(SEMIDENSE_STATUS_ERROR_HANDLE, semidense_last_error());
        }
        return descriptor;
    }

    // The oldest pose that has not been read.
    std::optional<pose> next_pose() { return ask<pose>(semidense_next_pose); }

    // The newest frame, where it has not been read.
    std::optional<frame> newest_frame() { return ask<frame>(semidense_newest_frame); }

    // The newest keyframe or revision of its depth, where it has not been read.
    std::optional<keyframe> newest_keyframe() { return ask<keyframe>(semidense_newest_keyframe); }

    // The poses of all keyframes, where they have changed.
    std::optional<graph> newest_graph() { return ask<graph>(semidense_newest_graph); }

    // Messages that were left out because they are broken.
    std::uint64_t refused() const { return semidense_refused(reader_); }

private:
    static semidense_status check(semidense_status status) {
        if (status < 0) {
            throw error(status, semidense_last_error());
        }
        return status;
    }

    template <typename T, typename Message>
    std::optional<T> ask(semidense_status (*call)(semidense_reader *, Message *)) {
        T message{};
        if (check(call(reader_, &message)) != SEMIDENSE_STATUS_OK) {
            return std::nullopt;
        }
        return message;
    }

    semidense_reader *reader_ = nullptr;
};

}  // namespace semidense

#endif
