// SPDX-License-Identifier: Apache-2.0
//
// Franka with libfranka, at 1 kHz.
//     franka ADDRESS record FILE SECONDS     record while another program or your hand moves the robot
//     franka ADDRESS run SECONDS             move 0.1 rad from here and back, with torques of the model

#include <franka/exception.h>
#include <franka/robot.h>

#include <cstdlib>
#include <fstream>
#include <iomanip>

#include "../torque_loop.hpp"

using namespace lipserve_examples;

namespace {

static_assert(kJoints == 7, "Export the model of a Franka.");

// Half of the robot's limits of torque, and its limit of rate: see "control parameters" of Franka's documentation.
const Limits kLimits = {
    /*max_torque=*/{43.0, 43.0, 43.0, 43.0, 6.0, 6.0, 6.0},
    /*max_rate=*/{900.0, 900.0, 900.0, 900.0, 900.0, 900.0, 900.0},
    /*max_std=*/{2.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0},
    /*stiffness=*/{200.0, 200.0, 200.0, 200.0, 80.0, 50.0, 20.0},
    /*damping=*/{20.0, 20.0, 20.0, 20.0, 8.0, 5.0, 3.0},
};

int record(franka::Robot& robot, const char* path, double seconds) {
  std::ofstream file(path);
  file << "t";
  for (const char* name : {"q", "dq", "tau"})
    for (std::size_t j = 1; j <= kJoints; ++j) file << ',' << name << j;
  file << '\n' << std::setprecision(12);
  double start = -1.0;
  robot.read([&](const franka::RobotState& state) {
    const double t = state.time.toSec();
    if (start < 0.0) start = t;
    file << t - start;
    for (const auto* part : {&state.q, &state.dq, &state.tau_J})
      for (const double value : *part) file << ',' << value;
    file << '\n';
    return t - start < seconds;
  });
  return file ? 0 : 1;
}

int run(franka::Robot& robot, double seconds) {
  if (!TorqueLoop::check({std::begin(lipserve_joint_names), std::end(lipserve_joint_names)})) return 1;
  Joints amplitude, start{};
  amplitude.fill(0.1);
  TorqueLoop loop(kLimits);  // libfranka adds gravity to every command
  double t = 0.0;
  bool is_first = true;
  robot.control(
      [&](const franka::RobotState& state, franka::Duration period) -> franka::Torques {
        if (is_first) start = state.q;
        is_first = false;
        t += period.toSec();
        const Desired desired = move_and_return(start, amplitude, 4.0, t);
        const franka::Torques command(loop.update(desired, state.q, state.dq, period.toSec()));
        return t >= seconds || loop.has_stopped() ? franka::MotionFinished(command) : command;
      },
      /*limit_rate=*/true);
  std::printf("%s\n", text(loop.stop()));
  return loop.stop() == Stop::none ? 0 : 1;
}

}  // namespace

int main(int count, char** arguments) {
  const std::string what = count > 2 ? arguments[2] : "";
  if (!(what == "record" && count == 5) && !(what == "run" && count == 4))
    return std::fputs("usage: franka ADDRESS record FILE SECONDS | franka ADDRESS run SECONDS\n", stderr), 2;
  try {
    franka::Robot robot(arguments[1]);
    const double seconds = std::atof(arguments[count - 1]);
    if (what == "record") return record(robot, arguments[3], seconds);
    robot.setCollisionBehavior({{20, 20, 18, 18, 16, 14, 12}}, {{20, 20, 18, 18, 16, 14, 12}},
                               {{20, 20, 20, 25, 25, 25}}, {{20, 20, 20, 25, 25, 25}});
    return run(robot, seconds);
  } catch (const franka::Exception& error) {
    return std::fprintf(stderr, "%s\n", error.what()), 1;
  }
}
