// SPDX-License-Identifier: Apache-2.0
//
// One cycle of a torque controller with a model exported as C: feed-forward by the model, feedback by stiffness and
// damping. It ramps in, clips torque and rate, and stops outside the range of the training. It does not allocate.
//
// It is not a safety function. Keep the limits and the emergency stop of the robot.
#ifndef LIPSERVE_EXAMPLES_TORQUE_LOOP_HPP
#define LIPSERVE_EXAMPLES_TORQUE_LOOP_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <string>
#include <vector>

#include "lipserve_model.h"

namespace lipserve_examples {

constexpr std::size_t kJoints = LIPSERVE_JOINTS;
using Joints = std::array<double, kJoints>;

struct Desired {
  Joints q, dq, ddq;
};

/// Torques that the robot adds itself, so that a command must not contain them.
struct RobotAdds {
  bool gravity = true, coriolis = false;
};

struct Limits {
  Joints max_torque;          // of the command, N·m
  Joints max_rate;            // of the command, N·m/s
  Joints max_std;             // the model's torque fades out above this standard deviation, N·m
  Joints stiffness, damping;  // of the feedback, N·m/rad and N·m·s/rad
  double period_s = 0.001;    // of a cycle; a longer gap does not permit a larger step
  double ramp_s = 2.0;        // until the torque is complete; it fades out ten times faster
  double margin = 0.05;       // permitted distance from the range of the training, as a share of its width
};

enum class Stop { none, not_finite, outside_range };

inline const char* text(Stop stop) {
  if (stop == Stop::not_finite) return "the state is not finite";
  return stop == Stop::none ? "no stop" : "the state is outside the range of the training";
}

class TorqueLoop {
 public:
  explicit TorqueLoop(const Limits& limits, RobotAdds adds = {}) : limits_(limits), adds_(adds) { restart(); }

  /// Call before the first cycle and before every new motion.
  void restart() {
    lipserve_start(&state_);
    stop_ = Stop::none;
    share_ = trust_ = 0.0;
    is_first_ = true;
  }

  /// Return whether the model computes here what the service computes, for these joints. Print what is wrong.
  static bool check(const std::vector<std::string>& joints) {
    if (const int vector = lipserve_selftest()) {
      std::fprintf(stderr, "Vector %d of the model's self-test differs. Check the compiler and its options.\n", vector);
      return false;
    }
    bool same = joints.size() == kJoints;
    for (std::size_t j = 0; same && j < kJoints; ++j) same = joints[j] == lipserve_joint_names[j];
    if (!same) std::fprintf(stderr, "The joints are not those of the model, in its order: see lipserve_model.h.\n");
    std::printf("model %s, version %d, revision %d\n", LIPSERVE_MODEL, LIPSERVE_VERSION, LIPSERVE_REVISION);
    return same;
  }

  /// Payload from the next cycle on; nullptr: none. It must outlive the loop.
  void set_payload(const lipserve_payload* payload) { payload_ = payload; }

  /// Return the command of this cycle. q, dq: as measured; dt: time since the last cycle, s.
  const Joints& update(const Desired& desired, const Joints& q, const Joints& dq, double dt) {
    check_state(desired, q, dq);
    const double step = std::isfinite(dt) ? std::clamp(dt, 0.0, limits_.period_s) : 0.0;
    Joints moving{};
    if (stop_ == Stop::none) {
      lipserve_update(&state_, q.data(), dq.data(), dt);
      moving = model_torque(desired, step);
      for (std::size_t j = 0; j < kJoints; ++j)
        moving[j] += limits_.stiffness[j] * (desired.q[j] - q[j]) + limits_.damping[j] * (desired.dq[j] - dq[j]);
      moving_ = moving;
      if (!adds_.gravity) lipserve_gravity_payload(q.data(), payload_, holding_.data());
    }
    fade(share_, stop_ == Stop::none, step);
    for (std::size_t j = 0; j < kJoints; ++j) {
      const double most = limits_.max_torque[j], change = limits_.max_rate[j] * step;
      const double wanted = std::clamp(holding_[j] + share_ * moving_[j], -most, most);
      command_[j] = is_first_ ? std::clamp(holding_[j], -most, most)
                              : std::clamp(wanted, command_[j] - change, command_[j] + change);
    }
    is_first_ = false;
    return command_;
  }

  Stop stop() const { return stop_; }

  /// Return whether a stop is complete: only the torque that holds the arm is left, none if the robot holds it.
  bool has_stopped() const {
    for (std::size_t j = 0; j < kJoints; ++j)
      if (std::abs(command_[j] - std::clamp(holding_[j], -limits_.max_torque[j], limits_.max_torque[j])) > 1e-9)
        return false;
    return stop_ != Stop::none && share_ == 0.0;
  }

 private:
  void check_state(const Desired& desired, const Joints& q, const Joints& dq) {
    const Joints* parts[] = {&q, &dq, &desired.q, &desired.dq, &desired.ddq};
    const int kinds[] = {0, 1, 0, 1, 2};
    for (std::size_t part = 0; part < 5 && stop_ == Stop::none; ++part)
      for (std::size_t j = 0; j < kJoints; ++j) {
        const double value = (*parts[part])[j];
        const double low = lipserve_range[kinds[part]][0][j], high = lipserve_range[kinds[part]][1][j];
        const double more = limits_.margin * (high - low);
        if (!std::isfinite(value))
          stop_ = Stop::not_finite;
        else if (stop_ == Stop::none && (value < low - more || value > high + more))
          stop_ = Stop::outside_range;
      }
  }

  /// Torque of the model without what the robot adds, times the trust in it.
  Joints model_torque(const Desired& desired, double step) {
    Joints tau, std, part;
    const double* q = desired.q.data();
    // the command contains gravity, if at all, at the measured position
    lipserve_torque_without_gravity(q, desired.dq.data(), desired.ddq.data(), payload_, &state_, tau.data(),
                                    std.data());
    if (adds_.coriolis) {
      lipserve_coriolis_payload(q, desired.dq.data(), payload_, part.data());
      for (std::size_t j = 0; j < kJoints; ++j) tau[j] -= part[j];
    }
    bool certain = true;
    for (std::size_t j = 0; j < kJoints; ++j) certain = certain && std[j] <= limits_.max_std[j];  // false for NaN
    fade(trust_, certain, step);
    for (std::size_t j = 0; j < kJoints; ++j) tau[j] = trust_ > 0.0 ? trust_ * tau[j] : 0.0;
    return tau;
  }

  void fade(double& share, bool in, double step) const {
    share = std::clamp(share + (in ? 1.0 : -10.0) * step / limits_.ramp_s, 0.0, 1.0);
  }

  Limits limits_;
  RobotAdds adds_;
  const lipserve_payload* payload_ = nullptr;
  lipserve_state state_ = {};
  Stop stop_ = Stop::none;
  double share_ = 0.0, trust_ = 0.0;
  bool is_first_ = true;
  Joints command_{}, moving_{}, holding_{};
};

/// A smooth motion for a first test: from the start by the amplitude and back, in each period.
inline Desired move_and_return(const Joints& start, const Joints& amplitude, double period_s, double t) {
  const double rate = 2.0 * 3.14159265358979323846 / period_s;
  Desired out;
  for (std::size_t j = 0; j < kJoints; ++j) {
    out.q[j] = start[j] + 0.5 * amplitude[j] * (1.0 - std::cos(rate * t));
    out.dq[j] = 0.5 * amplitude[j] * rate * std::sin(rate * t);
    out.ddq[j] = 0.5 * amplitude[j] * rate * rate * std::cos(rate * t);
  }
  return out;
}

}  // namespace lipserve_examples

#endif  // LIPSERVE_EXAMPLES_TORQUE_LOOP_HPP
