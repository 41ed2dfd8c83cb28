// SPDX-License-Identifier: Apache-2.0
//
// ROS 2 node that publishes the torque that a learnt model predicts for the measured motion, and its standard deviation.
// The model can learn from the measured torques.
//
//   ros2 run lipserve_ros2 feedforward --ros-args -p model:=panda-sim -p joints:="[panda_joint1, …]" -p stream:=cell-3
//
// Subscribes to joint_states (sensor_msgs/JointState: position, velocity, and effort, N·m, to learn from) and, with
// acceleration:=commanded, to commands (trajectory_msgs/JointTrajectory, accelerations of its first point).
// Publishes ~/feedforward and ~/feedforward_std (sensor_msgs/JointState): effort is the torque and its standard
// deviation, N·m; the stamp is that of the state. Late or missing torques are not published: a controller that adds the
// torque must check its age and its standard deviation. This is not a safety function.
//
// Callbacks put rows into a queue and never wait. A separate thread queries the torque of the newest row, then sends all
// rows in order to learn from.

#ifndef LIPSERVE_ROS2_FEEDFORWARD_HPP
#define LIPSERVE_ROS2_FEEDFORWARD_HPP

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <ctime>
#include <lipserve/client.hpp>
#include <lipserve_ros2/rows.hpp>
#include <memory>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>
#include <stdexcept>
#include <string>
#include <thread>
#include <trajectory_msgs/msg/joint_trajectory.hpp>
#include <utility>
#include <vector>

namespace lipserve_ros2 {

using lipserve::Deadline;
using lipserve::Status;
using sensor_msgs::msg::JointState;
using trajectory_msgs::msg::JointTrajectory;

class Feedforward : public rclcpp::Node {
 public:
  explicit Feedforward(const rclcpp::NodeOptions& options = rclcpp::NodeOptions())
      : Node("lipserve_feedforward", options),
        joints_(declare_parameter("joints", std::vector<std::string>{})),
        model_(declare_parameter("model", std::string{})),
        url_(url_of(declare_parameter("host", std::string{"127.0.0.1"}),
                    declare_parameter("port", std::int64_t{8000}))),
        key_(declare_parameter("key", std::string{})),
        stream_(run_of(declare_parameter("stream", std::string{}))),
        deadline_s_(declare_parameter("deadline_s", 0.002)),
        cutoff_hz_(declare_parameter("cutoff_hz", 20.0)),
        flush_s_(declare_parameter("flush_s", 1.0)),
        commanded_(is_commanded(declare_parameter("acceleration", std::string{"derived"}))),
        rows_(static_cast<std::size_t>(std::max<std::int64_t>(declare_parameter("rows", std::int64_t{256}), 1)),
              joints_.size()),
        places_(joints_.size()),
        last_dq_(joints_.size()),
        ddq_(joints_.size()) {
    if (joints_.empty() || model_.empty())
      throw std::invalid_argument("set the parameters model and joints: the model's joint names, in its order");
    tau_.name = std_.name = joints_;
    tau_publisher_ = create_publisher<JointState>("~/feedforward", rclcpp::SensorDataQoS());
    std_publisher_ = create_publisher<JointState>("~/feedforward_std", rclcpp::SensorDataQoS());
    states_ = create_subscription<JointState>(
        "joint_states", rclcpp::SensorDataQoS(), [this](const JointState::ConstSharedPtr message) { take(*message); });
    if (commanded_)
      commands_ = create_subscription<JointTrajectory>(
          "commands", rclcpp::SensorDataQoS(),
          [this](const JointTrajectory::ConstSharedPtr message) { follow(*message); });
    thread_ = std::thread([this] { serve(); });
  }

  ~Feedforward() override {
    stopping_.store(true);
    rows_.wake();
    thread_.join();
  }

  /// Return the number of states that were dropped because the queue of `rows` was full.
  std::uint64_t dropped() const { return dropped_.load(std::memory_order_relaxed); }

 private:
  static constexpr double longest_step_s = 0.1;  // max time between two states to derive an acceleration

  static std::string url_of(const std::string& host, std::int64_t port) {
    return host.compare(0, 7, "unix://") == 0 ? host : "http://" + host + ":" + std::to_string(port);
  }
  /// Return a new stream_id for each run: the service remembers the sequences of a stream.
  static std::string run_of(const std::string& stream) {
    if (stream.empty()) return stream;
    timespec now{};
    clock_gettime(CLOCK_REALTIME, &now);
    return stream + "-" + std::to_string(now.tv_sec) + "-" + std::to_string(now.tv_nsec);
  }
  static bool is_commanded(const std::string& source) {
    if (source != "derived" && source != "commanded")
      throw std::invalid_argument("acceleration is " + source + ", expected derived or commanded");
    return source == "commanded";
  }

  // -- callbacks: they never wait -------------------------------------------------------------------------------------

  /// Queue a state. States without a joint of the model, its velocity or its acceleration are ignored.
  void take(const JointState& message) {
    if (!find(message.name) || farthest_ >= std::min(message.position.size(), message.velocity.size())) return;
    const std::int64_t stamp = nanoseconds(message.header.stamp);
    if (!accelerate(message.velocity, stamp)) return;
    Row* const row = rows_.next();
    if (row == nullptr) {
      dropped_.fetch_add(1, std::memory_order_relaxed);
      return;
    }
    row->stamp_ns = stamp;
    row->has_tau = farthest_ < message.effort.size();
    for (std::size_t k = 0; k < joints_.size(); ++k) {
      const std::size_t place = places_[k];
      row->q[k] = message.position[place];
      row->dq[k] = message.velocity[place];
      row->ddq[k] = ddq_[k];
      row->tau[k] = row->has_tau ? message.effort[place] : 0.0;
      if (!std::isfinite(row->q[k] + row->dq[k] + row->ddq[k])) return;
      row->has_tau = row->has_tau && std::isfinite(row->tau[k]);
    }
    rows_.give();
  }

  /// Store the commanded accelerations.
  void follow(const JointTrajectory& message) {
    if (message.points.empty() || !find(message.joint_names)) return;
    const auto& accelerations = message.points.front().accelerations;
    if (farthest_ >= accelerations.size()) return;
    for (std::size_t k = 0; k < joints_.size(); ++k) ddq_[k] = accelerations[places_[k]];
    has_ddq_ = true;
  }

  /// Find the joints of the model in a message; usually their places are those of the last message.
  bool find(const std::vector<std::string>& names) {
    farthest_ = 0;
    for (std::size_t k = 0; k < joints_.size(); ++k) {
      if (places_[k] >= names.size() || names[places_[k]] != joints_[k])
        places_[k] = static_cast<std::size_t>(std::find(names.begin(), names.end(), joints_[k]) - names.begin());
      if (places_[k] == names.size()) return false;
      farthest_ = std::max(farthest_, places_[k]);
    }
    return true;
  }

  /// Update the acceleration of a state: the commanded one, or the low-pass filtered difference of velocities.
  bool accelerate(const std::vector<double>& velocity, std::int64_t stamp) {
    if (commanded_) return has_ddq_;
    const double step = static_cast<double>(stamp - last_stamp_) * 1e-9;
    const bool follows = last_stamp_ != 0 && step > 0.0 && step <= longest_step_s;
    const double share = cutoff_hz_ > 0.0 ? step / (step + 1.0 / (2.0 * M_PI * cutoff_hz_)) : 1.0;
    for (std::size_t k = 0; k < joints_.size(); ++k) {
      const double now = velocity[places_[k]];
      if (follows) {
        const double raw = (now - last_dq_[k]) / step;
        ddq_[k] = has_ddq_ ? ddq_[k] + share * (raw - ddq_[k]) : raw;
      }
      last_dq_[k] = now;
      if (!std::isfinite(now)) last_stamp_ = stamp = 0;  // restart after this state
    }
    last_stamp_ = stamp;
    has_ddq_ = follows && stamp != 0;
    return has_ddq_;
  }

  static std::int64_t nanoseconds(const builtin_interfaces::msg::Time& stamp) {
    return std::int64_t{stamp.sec} * 1'000'000'000 + stamp.nanosec;
  }

  // -- thread that talks to the service -------------------------------------------------------------------------------

  void serve() {
    lipserve::Options options;
    options.model = model_.c_str();
    options.joints = static_cast<unsigned>(joints_.size());
    options.url = url_.c_str();
    options.key = key_.empty() ? nullptr : key_.c_str();  // null: LIPSERVE_API_KEY
    options.stream_id = stream_.empty() ? nullptr : stream_.c_str();
    lipserve::Client client(options);
    lipserve::Answer answer;
    while (!stopping_.load()) {
      rows_.wait(50'000'000);
      const std::size_t waiting = rows_.waiting();
      if (waiting == 0) {
        client.tick();
        continue;
      }
      const Row& newest = rows_.at(waiting - 1);
      lipserve::Query query = query_of(newest);
      query.budget = deadline_s_;
      const Status status = client.ask(query, answer, Deadline::in(deadline_s_));
      note(client, status);
      if (status == Status::ok && !answer.late && knows_joints(client)) publish(newest, answer);
      for (std::size_t k = 0; k < waiting && !stream_.empty(); ++k)
        if (rows_.at(k).has_tau) client.teach(query_of(rows_.at(k)));
      rows_.drop(waiting);
    }
    if (!stream_.empty()) client.flush(Deadline::in(flush_s_));
    const lipserve::Learnt& learnt = client.learnt();
    RCLCPP_INFO(get_logger(),
                "stream %s: sent %llu, learnt %llu, rejected %llu, refused %llu, not acknowledged %zu, dropped %llu",
                stream_.empty() ? "none" : stream_.c_str(), static_cast<unsigned long long>(client.counters().taught),
                static_cast<unsigned long long>(learnt.accepted), static_cast<unsigned long long>(learnt.rejected),
                static_cast<unsigned long long>(learnt.refused),
                client.unsettled(), static_cast<unsigned long long>(dropped()));
  }

  static lipserve::Query query_of(const Row& row) {
    lipserve::Query query;
    query.q = row.q.data();
    query.dq = row.dq.data();
    query.ddq = row.ddq.data();
    query.tau = row.has_tau ? row.tau.data() : nullptr;
    return query;
  }

  void publish(const Row& row, const lipserve::Answer& answer) {
    for (auto* const message : {&tau_, &std_}) {
      message->header.stamp.sec = static_cast<std::int32_t>(row.stamp_ns / 1'000'000'000);
      message->header.stamp.nanosec = static_cast<std::uint32_t>(row.stamp_ns % 1'000'000'000);
    }
    tau_.position = row.q;
    tau_.velocity = row.dq;
    tau_.effort.assign(answer.tau, answer.tau + joints_.size());
    std_.effort.assign(answer.tau_std, answer.tau_std + joints_.size());
    tau_publisher_->publish(tau_);
    std_publisher_->publish(std_);
  }

  /// Return whether the model has these joints in this order; checked once per connection.
  bool knows_joints(const lipserve::Client& client) {
    if (client.counters().connections == checked_) return same_joints_;
    checked_ = client.counters().connections;
    same_joints_ = true;
    for (std::size_t k = 0; k < joints_.size(); ++k)
      same_joints_ = same_joints_ && joints_[k] == client.hello().joint_names[k];
    if (!same_joints_) RCLCPP_ERROR(get_logger(), "joint names differ from the model's: nothing is published");
    return same_joints_;
  }

  /// Log when answers start and stop.
  void note(const lipserve::Client& client, Status status) {
    if (status == last_) return;
    if (status == Status::ok)
      RCLCPP_INFO(get_logger(), "receiving answers of %s", model_.c_str());
    else
      RCLCPP_WARN(get_logger(), "no answer: %s", client.error().message);
    last_ = status;
  }

  const std::vector<std::string> joints_;
  const std::string model_, url_, key_, stream_;
  const double deadline_s_, cutoff_hz_, flush_s_;
  const bool commanded_;
  Rows rows_;
  std::atomic<bool> stopping_{false};
  std::atomic<std::uint64_t> dropped_{0};
  // used by the callbacks, which run one at a time in their callback group
  std::vector<std::size_t> places_;
  std::size_t farthest_ = 0;
  std::vector<double> last_dq_, ddq_;
  std::int64_t last_stamp_ = 0;
  bool has_ddq_ = false;
  // used by the thread
  JointState tau_, std_;
  std::uint64_t checked_ = 0;
  bool same_joints_ = false;
  Status last_ = Status::full;  // a value that `ask` never returns here
  rclcpp::Publisher<JointState>::SharedPtr tau_publisher_, std_publisher_;
  rclcpp::Subscription<JointState>::SharedPtr states_;
  rclcpp::Subscription<JointTrajectory>::SharedPtr commands_;
  std::thread thread_;
};

}  // namespace lipserve_ros2

#endif
