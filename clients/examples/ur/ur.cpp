// SPDX-License-Identifier: Apache-2.0
//
// Universal Robots with the Universal Robots Client Library: RTDE at 500 Hz.
//     ur ADDRESS SCRIPT record FILE SECONDS     record while a program on the robot moves it
//     ur ADDRESS SCRIPT run SECONDS             move 0.1 rad from here and back, with torques of the model
// SCRIPT: resources/external_control.urscript of the library. Start it in this folder: it reads the RTDE recipes here.

#include <ur_client_library/ur/ur_driver.h>

#include <cstdlib>
#include <fstream>
#include <iomanip>
#include <memory>

#include "../torque_loop.hpp"

using namespace lipserve_examples;

namespace {

static_assert(kJoints == 6, "Export the model of a UR.");

// About a third of the limits of a UR10e; choose those of your robot.
const Limits kLimits = {
    /*max_torque=*/{100.0, 100.0, 50.0, 18.0, 18.0, 18.0},
    /*max_rate=*/{500.0, 500.0, 500.0, 200.0, 200.0, 200.0},
    /*max_std=*/{8.0, 8.0, 5.0, 2.0, 2.0, 2.0},
    /*stiffness=*/{600.0, 600.0, 400.0, 100.0, 100.0, 50.0},
    /*damping=*/{40.0, 40.0, 25.0, 5.0, 5.0, 3.0},
    /*period_s=*/0.002,
};

struct Measured {
  double t = 0.0;
  urcl::vector6d_t q{}, dq{}, current{};
};

/// Wait for the next state. Return false if none arrives.
bool read(urcl::UrDriver& driver, Measured& measured) {
  const std::unique_ptr<urcl::rtde_interface::DataPackage> data = driver.getDataPackage();
  return data && data->getData("timestamp", measured.t) && data->getData("actual_q", measured.q) &&
         data->getData("actual_qd", measured.dq) && data->getData("actual_current", measured.current);
}

int record(urcl::UrDriver& driver, const char* path, double seconds) {
  std::ofstream file(path);
  file << "t";
  for (const char* name : {"q", "dq", "tau"})
    for (std::size_t j = 1; j <= kJoints; ++j) file << ',' << name << j;
  file << '\n' << std::setprecision(12);
  Measured measured;
  for (double start = -1.0; read(driver, measured) && (start < 0.0 || measured.t - start < seconds);) {
    if (start < 0.0) start = measured.t;
    file << measured.t - start;
    for (const auto* part : {&measured.q, &measured.dq, &measured.current})
      for (const double value : *part) file << ',' << value;
    file << '\n';
  }
  return file ? 0 : 1;
}

int run(urcl::UrDriver& driver, double seconds) {
  if (!TorqueLoop::check({std::begin(lipserve_joint_names), std::end(lipserve_joint_names)})) return 1;
  // the model contains friction, so the robot must not add it once more; it adds gravity to every torque
  if (!driver.setFrictionCompensation(false)) return 1;
  TorqueLoop loop(kLimits);
  Joints amplitude;
  amplitude.fill(0.1);
  Measured measured;
  if (!read(driver, measured)) return 1;
  const Measured start = measured;
  bool is_connected = true;
  for (double last = start.t; is_connected && measured.t - start.t < seconds && !loop.has_stopped();) {
    const Desired desired = move_and_return(start.q, amplitude, 4.0, measured.t - start.t);
    const Joints& command = loop.update(desired, measured.q, measured.dq, measured.t - last);
    last = measured.t;
    is_connected = driver.writeJointCommand(command, urcl::comm::ControlMode::MODE_TORQUE,
                                            urcl::RobotReceiveTimeout::millisec(20)) &&
                   read(driver, measured);
  }
  driver.stopControl();
  std::printf("%s\n", is_connected ? text(loop.stop()) : "the connection is lost");
  return is_connected && loop.stop() == Stop::none ? 0 : 1;
}

}  // namespace

int main(int count, char** arguments) {
  const std::string what = count > 3 ? arguments[3] : "";
  if (!(what == "record" && count == 6) && !(what == "run" && count == 5))
    return std::fputs("usage: ur ADDRESS SCRIPT record FILE SECONDS | ur ADDRESS SCRIPT run SECONDS\n", stderr), 2;
  try {
    urcl::UrDriverConfiguration configuration;
    configuration.robot_ip = arguments[1];
    configuration.script_file = arguments[2];
    configuration.output_recipe_file = "output_recipe.txt";
    configuration.input_recipe_file = "input_recipe.txt";
    configuration.handle_program_state = [](bool running) { std::printf(running ? "running\n" : "not running\n"); };
    configuration.headless_mode = what == "run";
    urcl::UrDriver driver(configuration);
    driver.startRTDECommunication();
    const double seconds = std::atof(arguments[count - 1]);
    if (what == "record") return record(driver, arguments[4], seconds);
    const urcl::VersionInformation version = driver.getVersion();
    const bool is_x = version.major >= 10;
    if (version < urcl::VersionInformation::fromString(is_x ? "10.10.0" : "5.23.0"))
      return std::fputs("Torque control needs PolyScope 5.23 or PolyScope X 10.10.\n", stderr), 1;
    return run(driver, seconds);
  } catch (const std::exception& error) {
    return std::fprintf(stderr, "%s\n", error.what()), 1;
  }
}
