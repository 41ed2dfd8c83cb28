// SPDX-License-Identifier: Apache-2.0
#ifndef LIPSERVE_ROS2_ROWS_HPP
#define LIPSERVE_ROS2_ROWS_HPP

#include <semaphore.h>

#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <ctime>
#include <vector>

namespace lipserve_ros2 {

/// One measured motion: q, rad; dq, rad/s; ddq, rad/s²; if `has_tau`, tau, N·m. One number per joint each.
struct Row {
  std::int64_t stamp_ns = 0;
  bool has_tau = false;
  std::vector<double> q, dq, ddq, tau;

  explicit Row(std::size_t joints) : q(joints), dq(joints), ddq(joints), tau(joints) {}
};

/// Queue of rows between two threads. The writing thread never waits, allocates or locks.
class Rows {
 public:
  Rows(std::size_t capacity, std::size_t joints) : rows_(capacity, Row(joints)) { sem_init(&given_, 0, 0); }
  ~Rows() { sem_destroy(&given_); }
  Rows(const Rows&) = delete;
  Rows& operator=(const Rows&) = delete;

  /// Return the row to fill next, or null if the queue is full. Call `give` afterwards.
  Row* next() {
    const std::size_t end = end_.load(std::memory_order_relaxed);
    return end - begin_.load(std::memory_order_acquire) < rows_.size() ? &rows_[end % rows_.size()] : nullptr;
  }
  void give() {
    end_.fetch_add(1, std::memory_order_release);
    wake();
  }
  void wake() { sem_post(&given_); }

  /// Wait until a row is given, at most the given nanoseconds (below a second).
  void wait(long nanoseconds) {
    timespec until{};
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_nsec += nanoseconds;
    if (until.tv_nsec >= 1'000'000'000) until.tv_nsec -= 1'000'000'000, ++until.tv_sec;
    while (sem_timedwait(&given_, &until) != 0 && errno == EINTR) {
    }
    while (sem_trywait(&given_) == 0) {
    }
  }
  /// Return the number of waiting rows.
  std::size_t waiting() const {
    return end_.load(std::memory_order_acquire) - begin_.load(std::memory_order_relaxed);
  }
  /// Return a waiting row, the oldest at place 0; it is valid until it is dropped.
  const Row& at(std::size_t place) const {
    return rows_[(begin_.load(std::memory_order_relaxed) + place) % rows_.size()];
  }
  /// Remove the oldest rows.
  void drop(std::size_t count) { begin_.fetch_add(count, std::memory_order_release); }

 private:
  std::vector<Row> rows_;
  std::atomic<std::size_t> begin_{0}, end_{0};  // only ever counted up
  sem_t given_;
};

}  // namespace lipserve_ros2

#endif
