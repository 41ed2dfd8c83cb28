// Stub of the Universal Robots Client Library: a robot that plays a recorded motion at 500 Hz. No code of the library;
// the declarations have its signatures.
#pragma once

#include <array>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>

#include "../../recording.hpp"

namespace urcl {

using vector6d_t = std::array<double, 6>;

namespace rtde_interface {

class DataPackage {
 public:
  double timestamp = 0.0;
  vector6d_t q{}, dq{}, current{};

  template <typename T>
  bool getData(const std::string& name, T& val) const {
    if constexpr (std::is_same_v<T, double>) {
      val = timestamp;
      return name == "timestamp";
    } else {
      val = name == "actual_q" ? q : name == "actual_qd" ? dq : current;
      return name == "actual_q" || name == "actual_qd" || name == "actual_current";
    }
  }
};

}  // namespace rtde_interface

namespace comm {
enum class ControlMode : int32_t { MODE_STOPPED = -2, MODE_IDLE = 0, MODE_TORQUE = 8 };
}

class RobotReceiveTimeout {
 public:
  static RobotReceiveTimeout millisec(const unsigned int milliseconds = 20) {
    return RobotReceiveTimeout(std::chrono::milliseconds(milliseconds));
  }
  std::chrono::milliseconds timeout_;

 private:
  explicit RobotReceiveTimeout(std::chrono::milliseconds timeout) : timeout_(timeout) {}
};

struct VersionInformation {
  uint32_t major = 0, minor = 0, bugfix = 0;
  static VersionInformation fromString(const std::string& text) {
    VersionInformation out;
    std::istringstream parts(text);
    char dot = '.';
    parts >> out.major >> dot >> out.minor >> dot >> out.bugfix;
    return out;
  }
  friend bool operator<(const VersionInformation& a, const VersionInformation& b) {
    return std::array{a.major, a.minor, a.bugfix} < std::array{b.major, b.minor, b.bugfix};
  }
};

struct UrDriverConfiguration {
  std::string robot_ip, script_file, output_recipe_file, input_recipe_file;
  std::function<void(bool)> handle_program_state;
  bool headless_mode;
};

class UrDriver {
 public:
  explicit UrDriver(const UrDriverConfiguration&) {}

  void startRTDECommunication() { rows_ = stub::motion(); }

  std::unique_ptr<rtde_interface::DataPackage> getDataPackage() {
    if (at_ >= rows_.size()) return nullptr;
    auto out = std::make_unique<rtde_interface::DataPackage>();
    out->timestamp = 100.0 + 0.002 * static_cast<double>(at_);
    for (std::size_t j = 0; j < 6; ++j) {
      out->q[j] = rows_[at_][j];
      out->dq[j] = rows_[at_][6 + j];
    }
    ++at_;
    return out;
  }

  bool setFrictionCompensation(const bool enabled) {
    is_friction_off_ = !enabled;
    return true;
  }

  bool writeJointCommand(const vector6d_t& values, const comm::ControlMode mode,
                         const RobotReceiveTimeout& = RobotReceiveTimeout::millisec(20)) {
    if (mode != comm::ControlMode::MODE_TORQUE || !is_friction_off_) throw std::logic_error("not torque control");
    stub::command(values, 6);
    return true;
  }

  bool stopControl() {
    stub::command(vector6d_t{}, 6);
    return true;
  }

  VersionInformation getVersion() {
    const char* version = std::getenv("POLYSCOPE");
    return VersionInformation::fromString(version ? version : "5.23.0");
  }

 private:
  std::vector<std::vector<double>> rows_;
  std::size_t at_ = 0;
  bool is_friction_off_ = false;
};

}  // namespace urcl
