// SPDX-License-Identifier: Apache-2.0
//
// KUKA LBR with the FRI client SDK: a torque overlay on joint impedance control, and a recorder.
//     fri [FILE]     FILE: write t, q, tau of the session, to train from
//
// The Sunrise application plans the motion and adds gravity and Coriolis torques of KUKA's own model. The overlay is
// the rest of the learnt torque: M(q) ddq and friction.

#include <friClientApplication.h>
#include <friLBRClient.h>
#include <friUdpConnection.h>

#include <cstdio>
#include <memory>

#include "../torque_loop.hpp"

using namespace lipserve_examples;

namespace {

static_assert(kJoints == KUKA::FRI::LBRState::NUMBER_OF_JOINTS, "Export the model of an LBR.");

constexpr int kPort = 30200;
constexpr double kSmoothing_s = 0.008;  // time constant of measured velocities

Limits limits() {
  Limits out = {
      /*max_torque=*/{20.0, 20.0, 15.0, 15.0, 10.0, 5.0, 5.0},
      /*max_rate=*/{200.0, 200.0, 200.0, 200.0, 100.0, 50.0, 50.0},
      /*max_std=*/{3.0, 3.0, 2.0, 2.0, 1.0, 0.5, 0.5},
      /*stiffness=*/{},  // the feedback is that of the Sunrise application
      /*damping=*/{},
  };
  return out;
}

RobotAdds robot_adds() {
  RobotAdds out;
  out.coriolis = true;
  return out;
}

class OverlayClient : public KUKA::FRI::LBRClient {
 public:
  explicit OverlayClient(std::FILE* file) : file_(file), loop_(limits(), robot_adds()) {
    if (file_) std::fprintf(file_, "t,q1,q2,q3,q4,q5,q6,q7,tau1,tau2,tau3,tau4,tau5,tau6,tau7\n");
  }

  void onStateChange(KUKA::FRI::ESessionState, KUKA::FRI::ESessionState state) override {
    if (state == KUKA::FRI::COMMANDING_ACTIVE) is_first_ = true;
  }

  void monitor() override {
    LBRClient::monitor();
    record();
  }

  void waitForCommand() override {
    LBRClient::waitForCommand();
    const Joints none{};
    if (robotState().getClientCommandMode() == KUKA::FRI::TORQUE) robotCommand().setTorque(none.data());
  }

  void command() override {
    LBRClient::command();  // mirrors the position of the interpolator
    record();
    if (robotState().getClientCommandMode() != KUKA::FRI::TORQUE) return;
    follow();
    robotCommand().setTorque(loop_.update(desired_, q_, dq_, is_first_ ? 0.0 : robotState().getSampleTime()).data());
    is_first_ = false;
    if (loop_.has_stopped() && !is_reported_) std::printf("%s: no overlay\n", text(loop_.stop()));
    is_reported_ = loop_.has_stopped();
  }

 private:
  /// Read positions; derive velocities and accelerations.
  void follow() {
    const double dt = robotState().getSampleTime();
    const double* measured = robotState().getMeasuredJointPosition();
    const double* planned = robotState().getIpoJointPosition();
    if (is_first_) {
      loop_.restart();
      dq_ = desired_.dq = desired_.ddq = Joints{};
      std::copy(measured, measured + kJoints, q_.begin());
      std::copy(planned, planned + kJoints, desired_.q.begin());
    }
    for (std::size_t j = 0; j < kJoints; ++j) {
      dq_[j] += dt / (dt + kSmoothing_s) * ((measured[j] - q_[j]) / dt - dq_[j]);
      const double velocity = (planned[j] - desired_.q[j]) / dt;
      desired_.ddq[j] = (velocity - desired_.dq[j]) / dt;
      desired_.dq[j] = velocity;
      q_[j] = measured[j];
      desired_.q[j] = planned[j];
    }
  }

  void record() {
    if (!file_) return;
    const unsigned int second = robotState().getTimestampSec();
    if (start_s_ == 0) start_s_ = second;
    std::fprintf(file_, "%.9f", second - start_s_ + 1e-9 * robotState().getTimestampNanoSec());
    for (const double* part : {robotState().getMeasuredJointPosition(), robotState().getMeasuredTorque()})
      for (std::size_t j = 0; j < kJoints; ++j) std::fprintf(file_, ",%.12g", part[j]);
    std::fprintf(file_, "\n");
  }

  std::FILE* file_;
  unsigned int start_s_ = 0;
  TorqueLoop loop_;
  Joints q_{}, dq_{};
  Desired desired_{};
  bool is_first_ = true, is_reported_ = false;
};

}  // namespace

int main(int count, char** arguments) {
  if (!TorqueLoop::check({std::begin(lipserve_joint_names), std::end(lipserve_joint_names)})) return 1;
  std::FILE* file = count > 1 ? std::fopen(arguments[1], "w") : nullptr;
  if (count > 1 && !file) return std::perror(arguments[1]), 1;
  KUKA::FRI::UdpConnection connection;
  OverlayClient client(file);
  KUKA::FRI::ClientApplication application(connection, client);
  if (!application.connect(kPort, nullptr)) return 1;
  while (application.step()) {
  }
  application.disconnect();
  return file && std::fclose(file) ? 1 : 0;
}
