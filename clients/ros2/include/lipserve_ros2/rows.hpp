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

/// One measured motion: q rad, dq rad/s, ddq rad/s² and, where `has_tau`, tau N·m, one number a joint each.
struct Row {
  std::int64_t stamp_ns = 0;
  bool has_tau = false;
  std::vector<double> q, dq, ddq, tau;

  explicit Row(std::size_t joints) : q(joints), dq(joints), ddq(joints), tau(joints) {}
};

/// Hands rows from one thread to another. The one that gives never waits, allocates nothing and takes no lock.
class Rows {
 public:
  Rows(std::size_t capacity, std::size_t joints) : rows_(capacity, Row(joints)) { sem_init(&given_, 0, 0); }
  ~Rows() { sem_destroy(&given_); }
  Rows(const Rows&) = delete;
  Rows& operator=(const Rows&) = delete;

  /// The row to fill next; null where all are waiting to be taken. Follow it by `give`.
  Row* next() {
    const std::size_t end = end_.load(std::memory_order_relaxed);
    return end - begin_.load(std::memory_order_acquire) < rows_.size() ? &rows_[end % rows_.size()] : nullptr;
  }
  void give() {
    end_.fetch_add(1, std::memory_order_release);
    wake();
  }
  void wake() { sem_post(&given_); }

  /// Wait until something is given, but no longer than so many nanoseconds (below a second).
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
  /// Rows that wait now.
  std::size_t waiting() const {
    return end_.load(std::memory_order_acquire) - begin_.load(std::memory_order_relaxed);
  }
  /// One of them, the oldest first; it holds until it is dropped.
  const Row& at(std::size_t place) const {
    return rows_[(begin_.load(std::memory_order_relaxed) + place) % rows_.size()];
  }
  /// Let the oldest be filled again.
  void drop(std::size_t count) { begin_.fetch_add(count, std::memory_order_release); }

 private:
  std::vector<Row> rows_;
  std::atomic<std::size_t> begin_{0}, end_{0};  // counted up for good
  sem_t given_;
};

}  // namespace lipserve_ros2

#endif
