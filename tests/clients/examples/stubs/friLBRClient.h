// Stub of the FRI client SDK: a session that plays a recorded motion. No code of the SDK; the declarations have its
// signatures.
#pragma once

#include <array>
#include <cstddef>

#include "recording.hpp"

namespace KUKA {
namespace FRI {

enum ESessionState { IDLE = 0, MONITORING_WAIT = 1, MONITORING_READY = 2, COMMANDING_WAIT = 3, COMMANDING_ACTIVE = 4 };
enum EClientCommandMode { NO_COMMAND_MODE = 0, POSITION = 1, WRENCH = 2, TORQUE = 3 };

class LBRState {
 public:
  enum { NUMBER_OF_JOINTS = 7 };
  double getSampleTime() const { return 0.001; }
  EClientCommandMode getClientCommandMode() const { return TORQUE; }
  unsigned int getTimestampSec() const { return 1000 + static_cast<unsigned int>(at / 1000); }
  unsigned int getTimestampNanoSec() const { return 1000000 * static_cast<unsigned int>(at % 1000); }
  const double* getMeasuredJointPosition() const { return row.data(); }
  const double* getIpoJointPosition() const { return row.data() + 7; }
  const double* getMeasuredTorque() const { return row.data() + 14; }

  std::vector<double> row;  // measured and planned position, measured torque
  std::size_t at = 0;
};

class LBRCommand {
 public:
  void setJointPosition(const double* values) { position = values; }
  void setTorque(const double* torques) { std::copy(torques, torques + 7, torque.begin()); }

  const double* position = nullptr;
  std::array<double, 7> torque{};
};

class IClient {
 public:
  virtual ~IClient() = default;
  virtual void onStateChange(ESessionState oldState, ESessionState newState) = 0;
  virtual void monitor() = 0;
  virtual void waitForCommand() = 0;
  virtual void command() = 0;
};

class LBRClient : public IClient {
 public:
  void onStateChange(ESessionState, ESessionState) override {}
  void monitor() override {}
  void waitForCommand() override { _robotCommand.setJointPosition(_robotState.getIpoJointPosition()); }
  void command() override { _robotCommand.setJointPosition(_robotState.getIpoJointPosition()); }
  const LBRState& robotState() const { return _robotState; }
  LBRCommand& robotCommand() { return _robotCommand; }

 private:
  friend class ClientApplication;
  LBRState _robotState;
  LBRCommand _robotCommand;
};

}  // namespace FRI
}  // namespace KUKA
