// Stub of libfranka: a robot that plays a recorded motion, and rejects torques as the real one does. No code of
// libfranka; the declarations have its signatures.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <string>

#include "../recording.hpp"
#include "exception.h"

namespace franka {

class Duration {
 public:
  explicit Duration(uint64_t milliseconds = 0) noexcept : milliseconds_(milliseconds) {}
  double toSec() const noexcept { return 1e-3 * static_cast<double>(milliseconds_); }

 private:
  uint64_t milliseconds_;
};

struct RobotState {
  std::array<double, 7> tau_J{}, q{}, dq{};
  Duration time{};
};

struct Finishable {
  bool motion_finished = false;
};

class Torques : public Finishable {
 public:
  Torques(const std::array<double, 7>& torques) noexcept : tau_J(torques) {}
  std::array<double, 7> tau_J{};
};

inline Torques MotionFinished(Torques command) noexcept {
  command.motion_finished = true;
  return command;
}

enum class RealtimeConfig { kEnforce, kIgnore };
constexpr double kMaxCutoffFrequency = 1000.0, kDefaultCutoffFrequency = 100.0;

class Robot {
 public:
  explicit Robot(const std::string&, RealtimeConfig = RealtimeConfig::kEnforce, size_t = 50) {}

  void setCollisionBehavior(const std::array<double, 7>&, const std::array<double, 7>&, const std::array<double, 6>&,
                            const std::array<double, 6>&) {}

  void read(std::function<bool(const RobotState&)> read_callback) {
    for (const RobotState& state : states())
      if (!read_callback(state)) return;
  }

  void control(std::function<Torques(const RobotState&, Duration)> control_callback, bool limit_rate = false,
               double = kDefaultCutoffFrequency) {
    if (!limit_rate) throw Exception("the example must ask for rate limits");
    std::array<double, 7> last{};
    bool is_first = true;
    for (const RobotState& state : states()) {
      const Torques command = control_callback(state, Duration(is_first ? 0 : 1));
      stub::command(command.tau_J, 7);
      for (std::size_t j = 0; j < 7; ++j) {
        if (!(std::abs(command.tau_J[j]) <= (j < 4 ? 87.0 : 12.0))) throw ControlException("tau_j_range_violation");
        if (!(std::abs(command.tau_J[j] - last[j]) <= 1.0)) throw ControlException("controller_torque_discontinuity");
      }
      last = command.tau_J;
      is_first = false;
      if (command.motion_finished) return;
    }
  }

 private:
  /// States of the rows q, dq, and tau_J if given.
  static std::vector<RobotState> states() {
    std::vector<RobotState> out;
    for (const std::vector<double>& row : stub::motion()) {
      RobotState state;
      for (std::size_t j = 0; j < 7; ++j) {
        state.q[j] = row[j];
        state.dq[j] = row[7 + j];
        state.tau_J[j] = row.size() > 14 ? row[14 + j] : 0.0;
      }
      state.time = Duration(5000 + out.size());
      out.push_back(state);
    }
    return out;
  }
};

}  // namespace franka
