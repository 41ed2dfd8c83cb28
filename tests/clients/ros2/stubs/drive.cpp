// SPDX-License-Identifier: Apache-2.0
//
// ROS 2 node on an in-process bus. It reads commands from standard input and answers each with a line of JSON:
//     state ROW SECONDS   publishes a state and waits for its torque | states FROM TO   publishes and waits for none
//     command ROW   publishes the accelerations of a row | end   ends the node
// Arguments: parameters of the node, name=value; rows_file=FILE has rows of 4 · joints doubles: q, dq, ddq, tau;
// period=SECONDS between the stamps of two states.

#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <lipserve_ros2/feedforward.hpp>
#include <mutex>

namespace {

using sensor_msgs::msg::JointState;

std::mutex lock;
std::condition_variable changed;
JointState tau, deviation;

std::int64_t stamp_of(const JointState& message) {
  return std::int64_t{message.header.stamp.sec} * 1'000'000'000 + message.header.stamp.nanosec;
}

void keep(JointState& place, const void* message) {
  const std::lock_guard<std::mutex> held(lock);
  place = *static_cast<const JointState*>(message);
  changed.notify_all();
}

void print(const char* name, const std::vector<double>& values) {
  std::printf("\"%s\": [", name);
  for (std::size_t k = 0; k < values.size(); ++k) std::printf("%s%.17g", k ? ", " : "", values[k]);
  std::printf("]");
}

/// Names and values in another order than the model's: another joint first, then those of the model in reverse.
template <class Value>
std::vector<Value> turned(const std::vector<Value>& values, const Value& other) {
  std::vector<Value> out{other};
  out.insert(out.end(), values.rbegin(), values.rend());
  return out;
}

}  // namespace

int main(int count, char** arguments) {
  auto& bus = rclcpp::bus();
  std::vector<double> rows;
  double period = 0.001;
  for (int k = 1; k < count; ++k) {
    const std::string given = arguments[k];
    const auto equals = given.find('=');
    const std::string name = given.substr(0, equals), value = given.substr(equals + 1);
    if (name == "rows_file") {
      std::ifstream file(value, std::ios::binary | std::ios::ate);
      rows.resize(static_cast<std::size_t>(file.tellg()) / sizeof(double));
      file.seekg(0);
      file.read(reinterpret_cast<char*>(rows.data()), static_cast<std::streamsize>(rows.size() * sizeof(double)));
    } else if (name == "period") {
      period = std::stod(value);
    } else {
      bus.parameters[name] = value;
    }
  }
  std::vector<std::string> joints;
  rclcpp::from_text(bus.parameters["joints"], joints);
  bus.published["~/feedforward"] = [](const void* message) { keep(tau, message); };
  bus.published["~/feedforward_std"] = [](const void* message) { keep(deviation, message); };
  auto node = std::make_shared<lipserve_ros2::Feedforward>();

  const auto part = [&](std::size_t row, std::size_t which) {
    const double* begin = &rows[(row * 4 + which) * joints.size()];
    return turned(std::vector<double>(begin, begin + joints.size()), 99.0);
  };
  std::int64_t stamp = 1'000'000'000;
  const auto state = [&](std::size_t row) {
    stamp += static_cast<std::int64_t>(period * 1e9);
    auto message = std::make_shared<JointState>();
    message->header.stamp.sec = static_cast<std::int32_t>(stamp / 1'000'000'000);
    message->header.stamp.nanosec = static_cast<std::uint32_t>(stamp % 1'000'000'000);
    message->name = turned(joints, std::string("gripper"));
    message->position = part(row, 0);
    message->velocity = part(row, 1);
    message->effort = part(row, 3);
    bus.subscriptions["joint_states"](message);
  };

  for (std::string word; std::cin >> word && word != "end";) {
    std::size_t from = 0, to = 0;
    std::cin >> from;
    bool answered = false;
    if (word == "states") {
      std::cin >> to;
      for (std::size_t row = from; row < to; ++row) state(row);
    } else if (word == "command") {
      auto message = std::make_shared<trajectory_msgs::msg::JointTrajectory>();
      message->joint_names = turned(joints, std::string("gripper"));
      message->points.resize(1);
      message->points.front().accelerations = part(from, 2);
      bus.subscriptions["commands"](message);
    } else {
      double seconds = 0.0;
      std::cin >> seconds;
      state(from);
      std::unique_lock<std::mutex> held(lock);
      answered = changed.wait_for(held, std::chrono::duration<double>(seconds), [&] {
        return stamp_of(tau) == stamp && stamp_of(deviation) == stamp;
      });
    }
    const std::lock_guard<std::mutex> held(lock);
    std::printf("{\"answered\": %s, \"dropped\": %llu, ", answered ? "true" : "false",
                static_cast<unsigned long long>(node->dropped()));
    print("tau", tau.effort);
    std::printf(", ");
    print("std", deviation.effort);
    std::printf(", \"first\": \"%s\"}\n", tau.name.empty() ? "" : tau.name.front().c_str());
    std::fflush(stdout);
  }
  node.reset();
}
