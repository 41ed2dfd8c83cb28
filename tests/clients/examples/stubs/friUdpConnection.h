// Stub of the FRI client SDK.
#pragma once

namespace KUKA {
namespace FRI {

class IConnection {};
class UdpConnection : public IConnection {
 public:
  UdpConnection(unsigned int = 0) {}
};

}  // namespace FRI
}  // namespace KUKA
