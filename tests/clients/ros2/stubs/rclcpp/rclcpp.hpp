// Stub of the part of rclcpp that the node uses, for machines without ROS 2: an in-process bus for tests.
#ifndef STUB_RCLCPP_HPP
#define STUB_RCLCPP_HPP

#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

namespace rclcpp {

/// Parameters set by a test, as text; subscriptions and publishers by topic.
struct Bus {
  std::map<std::string, std::string> parameters;
  std::map<std::string, std::function<void(std::shared_ptr<const void>)>> subscriptions;
  std::map<std::string, std::function<void(const void*)>> published;
};
inline Bus& bus() {
  static Bus only;
  return only;
}

inline void from_text(const std::string& text, std::string& value) { value = text; }
inline void from_text(const std::string& text, double& value) { value = std::stod(text); }
inline void from_text(const std::string& text, std::int64_t& value) { value = std::stoll(text); }
inline void from_text(const std::string& text, std::vector<std::string>& value) {
  std::istringstream parts(text);
  value.clear();
  for (std::string part; std::getline(parts, part, ',');) value.push_back(part);
}

struct NodeOptions {};
struct SensorDataQoS {};
struct Logger {};

template <class Message>
struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  std::string topic;
  void publish(const Message& message) {
    if (const auto found = bus().published.find(topic); found != bus().published.end()) found->second(&message);
  }
};

template <class Message>
struct Subscription {
  using SharedPtr = std::shared_ptr<Subscription>;
};

class Node {
 public:
  Node(const std::string&, const NodeOptions&) {}
  virtual ~Node() = default;

  template <class Value>
  Value declare_parameter(const std::string& name, const Value& otherwise) {
    Value value = otherwise;
    if (const auto found = bus().parameters.find(name); found != bus().parameters.end()) from_text(found->second, value);
    return value;
  }
  template <class Message>
  typename Publisher<Message>::SharedPtr create_publisher(const std::string& topic, const SensorDataQoS&) {
    auto made = std::make_shared<Publisher<Message>>();
    made->topic = topic;
    return made;
  }
  template <class Message, class Callback>
  typename Subscription<Message>::SharedPtr create_subscription(const std::string& topic, const SensorDataQoS&,
                                                                Callback callback) {
    bus().subscriptions[topic] = [callback](std::shared_ptr<const void> message) {
      callback(std::static_pointer_cast<const Message>(message));
    };
    return std::make_shared<Subscription<Message>>();
  }
  Logger get_logger() const { return {}; }
};

inline void init(int, char**) {}
inline void spin(const std::shared_ptr<Node>&) {}
inline void shutdown() {}

}  // namespace rclcpp

#define STUB_LOG(logger, ...) (static_cast<void>(logger), std::fprintf(stderr, __VA_ARGS__), std::fputc('\n', stderr))
#define RCLCPP_INFO(logger, ...) STUB_LOG(logger, __VA_ARGS__)
#define RCLCPP_WARN(logger, ...) STUB_LOG(logger, __VA_ARGS__)
#define RCLCPP_ERROR(logger, ...) STUB_LOG(logger, __VA_ARGS__)

#endif
