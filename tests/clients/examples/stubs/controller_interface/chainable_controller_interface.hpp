// Stub of ros2_control (Jazzy): what a chainable controller needs, in one process. No code of ros2_control; the
// declarations have its signatures.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "../recording.hpp"

namespace rclcpp {

struct Time {};

class Duration {
 public:
  static Duration from_seconds(double seconds) {
    Duration out;
    out.seconds_ = seconds;
    return out;
  }
  double seconds() const { return seconds_; }

 private:
  double seconds_ = 0.0;
};

struct Parameter {
  bool flag = false;
  std::vector<double> numbers;
  std::vector<std::string> words;
  bool as_bool() const { return flag; }
  std::vector<double> as_double_array() const { return numbers; }
  std::vector<std::string> as_string_array() const { return words; }
};

}  // namespace rclcpp

namespace rclcpp_lifecycle {

struct State {};

class LifecycleNode {
 public:
  const char* get_name() const { return "feedforward"; }
  rclcpp::Parameter get_parameter(const std::string& name) const { return parameters.at(name); }
  std::map<std::string, rclcpp::Parameter> parameters;
};

}  // namespace rclcpp_lifecycle

namespace hardware_interface {

class CommandInterface {
 public:
  CommandInterface(const std::string& prefix_name, const std::string& interface_name, double* value_ptr)
      : name(prefix_name + "/" + interface_name), value(value_ptr) {}
  std::string name;
  double* value;
};

class LoanedCommandInterface {
 public:
  explicit LoanedCommandInterface(double* value) : value_(value) {}
  template <typename T>
  [[nodiscard]] bool set_value(const T& value, unsigned int = 10) {
    *value_ = value;
    return true;
  }

 private:
  double* value_;
};

class LoanedStateInterface {
 public:
  explicit LoanedStateInterface(const double* value) : value_(value) {}
  template <typename T = double>
  [[nodiscard]] std::optional<T> get_optional(unsigned int = 10) const {
    return *value_;
  }

 private:
  const double* value_;
};

}  // namespace hardware_interface

namespace controller_interface {

enum class CallbackReturn : uint8_t { SUCCESS = 97, FAILURE = 98, ERROR = 99 };
enum class return_type : std::uint8_t { OK = 0, ERROR = 1 };
enum class interface_configuration_type : std::uint8_t { ALL = 0, INDIVIDUAL = 1, NONE = 2 };

struct InterfaceConfiguration {
  interface_configuration_type type;
  std::vector<std::string> names = {};
};

class ControllerInterfaceBase {
 public:
  virtual ~ControllerInterfaceBase() = default;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_init() = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State& previous_state) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State& previous_state) = 0;
  unsigned int get_update_rate() const { return 1000; }
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const { return node_; }

  template <typename ParameterT>
  auto auto_declare(const std::string& name, const ParameterT&) {
    node_->parameters.try_emplace(name);
  }

  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;

 private:
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_ = std::make_shared<rclcpp_lifecycle::LifecycleNode>();
};

class ChainableControllerInterface : public ControllerInterfaceBase {
 public:
  return_type update(const rclcpp::Time& time, const rclcpp::Duration& period) {
    return update_and_write_commands(time, period);
  }
  std::vector<hardware_interface::CommandInterface> export_references() { return on_export_reference_interfaces(); }

 protected:
  virtual std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() = 0;
  virtual return_type update_reference_from_subscribers(const rclcpp::Time& time, const rclcpp::Duration& period) = 0;
  virtual return_type update_and_write_commands(const rclcpp::Time& time, const rclcpp::Duration& period) = 0;
  std::vector<double> reference_interfaces_;
};

}  // namespace controller_interface
