// A controller manager with one chained controller: plays a recorded motion, with references in the same rows.
//     drive_controller ADDS_GRAVITY JOINT...

#include <cstdio>
#include <cstring>
#include <pluginlib/class_list_macros.hpp>

#include "controller_interface/chainable_controller_interface.hpp"

std::unique_ptr<controller_interface::ChainableControllerInterface> make_plugin();

int main(int count, char** arguments) {
  using controller_interface::CallbackReturn;
  const std::vector<std::string> joints(arguments + 2, arguments + count);
  const std::size_t n = joints.size();
  auto controller = make_plugin();
  controller->on_init();
  auto& parameters = controller->get_node()->parameters;
  parameters.at("joints").words = joints;
  parameters.at("robot_adds_gravity").flag = std::strcmp(arguments[1], "true") == 0;
  const std::map<std::string, double> values = {
      {"max_torque", 60.0}, {"max_rate", 500.0}, {"max_std", 2.0}, {"stiffness", 50.0}, {"damping", 5.0}};
  for (const auto& [name, value] : values) parameters.at(name).numbers.assign(n, value);
  if (controller->on_configure({}) != CallbackReturn::SUCCESS) return std::fputs("not configured\n", stderr), 3;
  const std::vector<std::vector<double>> rows = stub::motion();
  std::vector<double> states(2 * n), commands(n), row = rows[0];
  const auto wanted = controller->state_interface_configuration().names;
  for (std::size_t j = 0; j < n; ++j) {
    if (wanted[2 * j] != joints[j] + "/position" || wanted[2 * j + 1] != joints[j] + "/velocity") return 4;
    if (controller->command_interface_configuration().names[j] != joints[j] + "/effort") return 4;
    controller->command_interfaces_.emplace_back(&commands[j]);
    for (std::size_t kind = 0; kind < 2; ++kind) controller->state_interfaces_.emplace_back(&states[2 * j + kind]);
  }
  const auto references = controller->export_references();
  if (references.size() != 3 * n || references[n].name != "feedforward/" + joints[0] + "/velocity") return 4;
  const auto play = [&](const std::vector<double>& at) {
    for (std::size_t j = 0; j < n; ++j)
      for (std::size_t kind = 0; kind < 2; ++kind) states[2 * j + kind] = at[kind * n + j];
  };
  play(rows[0]);
  if (controller->on_activate({}) != CallbackReturn::SUCCESS) return 5;
  for (std::size_t k = 0; k < rows.size(); ++k) {
    play(rows[k]);
    for (std::size_t place = 0; place < 3 * n; ++place) *references[place].value = rows[k][2 * n + place];
    const auto done = controller->update({}, rclcpp::Duration::from_seconds(0.001));
    stub::command(commands, n);
    if (done != controller_interface::return_type::OK) return std::printf("deactivated\n"), 1;
  }
  return 0;
}
