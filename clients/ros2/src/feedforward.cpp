// SPDX-License-Identifier: Apache-2.0
#include <lipserve_ros2/feedforward.hpp>
#include <memory>

int main(int count, char** arguments) {
  rclcpp::init(count, arguments);
  rclcpp::spin(std::make_shared<lipserve_ros2::Feedforward>());
  rclcpp::shutdown();
}
