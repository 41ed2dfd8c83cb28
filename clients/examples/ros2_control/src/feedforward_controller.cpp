// SPDX-License-Identifier: Apache-2.0
//
// A chainable controller for ros2_control: joint_trajectory_controller writes position, velocity and acceleration to its
// references, it writes efforts with the torque of the model. For Jazzy and later.

#include <controller_interface/chainable_controller_interface.hpp>
#include <hardware_interface/types/hardware_interface_type_values.hpp>
#include <pluginlib/class_list_macros.hpp>

#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "../../torque_loop.hpp"

namespace lipserve_examples {

using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::return_type;

class FeedforwardController : public controller_interface::ChainableControllerInterface {
 public:
  CallbackReturn on_init() override {
    auto_declare<std::vector<std::string>>("joints", {});
    auto_declare<bool>("robot_adds_gravity", true);
    for (const char* name : {"max_torque", "max_rate", "max_std", "stiffness", "damping"})
      auto_declare<std::vector<double>>(name, {});
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_configure(const rclcpp_lifecycle::State&) override {
    joints_ = get_node()->get_parameter("joints").as_string_array();
    if (!TorqueLoop::check(joints_)) return CallbackReturn::ERROR;
    Limits limits;
    if (!read("max_torque", limits.max_torque) || !read("max_rate", limits.max_rate) ||
        !read("max_std", limits.max_std) || !read("stiffness", limits.stiffness) || !read("damping", limits.damping))
      return CallbackReturn::ERROR;
    limits.period_s = get_update_rate() > 0 ? 1.0 / get_update_rate() : limits.period_s;
    RobotAdds adds;
    adds.gravity = get_node()->get_parameter("robot_adds_gravity").as_bool();
    loop_ = std::make_unique<TorqueLoop>(limits, adds);
    return CallbackReturn::SUCCESS;
  }

  InterfaceConfiguration command_interface_configuration() const override {
    return interfaces({hardware_interface::HW_IF_EFFORT});
  }

  InterfaceConfiguration state_interface_configuration() const override {
    return interfaces({hardware_interface::HW_IF_POSITION, hardware_interface::HW_IF_VELOCITY});
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State&) override {
    loop_->restart();
    Joints q{}, dq{};
    if (!read_state(q, dq)) return CallbackReturn::ERROR;
    for (std::size_t j = 0; j < kJoints; ++j) {  // hold this posture until a trajectory arrives
      reference_interfaces_[j] = q[j];
      reference_interfaces_[kJoints + j] = reference_interfaces_[2 * kJoints + j] = 0.0;
    }
    is_first_ = true;
    return CallbackReturn::SUCCESS;
  }

  return_type update_reference_from_subscribers(const rclcpp::Time&, const rclcpp::Duration&) override {
    return return_type::OK;  // without a chain it holds its posture
  }

  /// Return ERROR after a stop: the controller manager then deactivates the controller, and the hardware must brake.
  return_type update_and_write_commands(const rclcpp::Time&, const rclcpp::Duration& period) override {
    Joints q{}, dq{};
    if (!read_state(q, dq)) q.fill(std::numeric_limits<double>::quiet_NaN());
    Desired desired;
    for (std::size_t j = 0; j < kJoints; ++j) {
      desired.q[j] = reference_interfaces_[j];
      desired.dq[j] = reference_interfaces_[kJoints + j];
      desired.ddq[j] = reference_interfaces_[2 * kJoints + j];
    }
    const Joints& command = loop_->update(desired, q, dq, is_first_ ? 0.0 : period.seconds());
    is_first_ = false;
    bool written = true;
    for (std::size_t j = 0; j < kJoints; ++j) written = command_interfaces_[j].set_value(command[j]) && written;
    return written && !loop_->has_stopped() ? return_type::OK : return_type::ERROR;
  }

 protected:
  std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() override {
    std::vector<hardware_interface::CommandInterface> out;
    reference_interfaces_.assign(3 * kJoints, 0.0);
    const std::string name = get_node()->get_name();
    std::size_t place = 0;
    for (const char* kind : {hardware_interface::HW_IF_POSITION, hardware_interface::HW_IF_VELOCITY,
                             hardware_interface::HW_IF_ACCELERATION})
      for (const std::string& joint : joints_)
        out.emplace_back(name, joint + "/" + kind, &reference_interfaces_[place++]);
    return out;
  }

 private:
  bool read(const std::string& name, Joints& out) {
    const std::vector<double> values = get_node()->get_parameter(name).as_double_array();
    if (values.size() != kJoints) {
      std::fprintf(stderr, "Parameter %s has %zu values; the model has %zu joints.\n", name.c_str(), values.size(),
                   kJoints);
      return false;
    }
    std::copy(values.begin(), values.end(), out.begin());
    return true;
  }

  bool read_state(Joints& q, Joints& dq) const {
    for (std::size_t j = 0; j < kJoints; ++j) {
      const std::optional<double> position = state_interfaces_[2 * j].get_optional();
      const std::optional<double> velocity = state_interfaces_[2 * j + 1].get_optional();
      if (!position || !velocity) return false;
      q[j] = *position;
      dq[j] = *velocity;
    }
    return true;
  }

  InterfaceConfiguration interfaces(const std::vector<std::string>& kinds) const {
    InterfaceConfiguration out{controller_interface::interface_configuration_type::INDIVIDUAL, {}};
    for (const std::string& joint : joints_)
      for (const std::string& kind : kinds) out.names.push_back(joint + "/" + kind);
    return out;
  }

  std::vector<std::string> joints_;
  std::unique_ptr<TorqueLoop> loop_;
  bool is_first_ = true;
};

}  // namespace lipserve_examples

PLUGINLIB_EXPORT_CLASS(lipserve_examples::FeedforwardController, controller_interface::ChainableControllerInterface)
