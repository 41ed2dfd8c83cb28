// Stub of the FRI client SDK.
#pragma once

#include <stdexcept>

#include "friLBRClient.h"
#include "friUdpConnection.h"

namespace KUKA {
namespace FRI {

class ClientApplication {
 public:
  ClientApplication(IConnection&, IClient& client) : client_(static_cast<LBRClient&>(client)) {}

  bool connect(int, const char* = nullptr) {
    rows_ = stub::motion();
    next();
    client_.monitor();
    client_.waitForCommand();
    for (const double each : client_.robotCommand().torque)
      if (each != 0.0) throw std::logic_error("a torque before the first command");
    client_.onStateChange(COMMANDING_WAIT, COMMANDING_ACTIVE);
    return true;
  }

  bool step() {
    if (at_ >= rows_.size()) return false;
    next();
    client_.command();
    if (client_.robotCommand().position != client_.robotState().getIpoJointPosition())
      throw std::logic_error("the position is not that of the interpolator");
    stub::command(client_.robotCommand().torque, 7);
    ++at_;
    return true;
  }

  void disconnect() {}

 private:
  void next() {
    client_._robotState.row = rows_[at_];
    client_._robotState.at = at_;
  }

  LBRClient& client_;
  std::vector<std::vector<double>> rows_;
  std::size_t at_ = 0;
};

}  // namespace FRI
}  // namespace KUKA
