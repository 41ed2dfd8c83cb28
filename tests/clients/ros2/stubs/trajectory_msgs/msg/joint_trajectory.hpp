// Stub of trajectory_msgs/JointTrajectory with the fields that the node uses.
#ifndef STUB_JOINT_TRAJECTORY_HPP
#define STUB_JOINT_TRAJECTORY_HPP

#include <memory>
#include <sensor_msgs/msg/joint_state.hpp>
#include <string>
#include <vector>

namespace trajectory_msgs::msg {
struct JointTrajectoryPoint {
  std::vector<double> positions, velocities, accelerations, effort;
};
struct JointTrajectory {
  using ConstSharedPtr = std::shared_ptr<const JointTrajectory>;
  std_msgs::msg::Header header;
  std::vector<std::string> joint_names;
  std::vector<JointTrajectoryPoint> points;
};
}  // namespace trajectory_msgs::msg

#endif
