"""A ROS 2 node that sends `sensor_msgs/JointState` to a model to learn from: an example, not part of the package.

    python docs/examples/ros2_bridge.py --ros-args -p model:=my-panda -p topic:=/joint_states

It needs rclpy of your ROS 2 and `pip install lipserve-client`. Efforts must be joint torques in N·m, in the model's
convention. The service derives accelerations from velocities and times.
"""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState

from lipserve import ApiError, Client, ServiceUnreachableError

MAX_BATCHES = 100
"""Max number of unsent batches. Beyond it the oldest is dropped, with an error in the log."""


class Bridge(Node):
    """Collects rows in the callback, which never waits, and sends them from another thread."""

    def __init__(self) -> None:
        super().__init__("lipserve_bridge")
        given = {"model": "", "url": "", "topic": "/joint_states", "rows": 100}
        for name, default in given.items():
            self.declare_parameter(name, default)
        self.model, url, topic, self.rows = (self.get_parameter(name).value for name in given)
        self.client = Client(url)  # if empty, LIPSERVE_URL
        serving = self.client.model(self.model).serving_version
        self.joints = self.client.version(self.model, serving).joint_names
        # stream_id and sequence identify a batch forever, so each run of the node is a new stream
        self.stream_id = f"ros2-{time.time_ns()}"
        self.batch: list[tuple[float, list[float], list[float], list[float]]] = []
        self.waiting: queue.Queue[Any] = queue.Queue(MAX_BATCHES)
        self.sender = threading.Thread(target=self.send, daemon=True)
        self.sender.start()
        self.create_subscription(JointState, topic, self.collect, 100)

    def collect(self, message: JointState) -> None:
        """Store a row; ignore messages without a joint of the model, its velocity or its effort."""
        at = {name: place for place, name in enumerate(message.name)}
        if not all(joint in at for joint in self.joints):
            return
        places = [at[joint] for joint in self.joints]
        if max(places) >= min(len(message.position), len(message.velocity), len(message.effort)):
            return
        q, dq, tau = (
            [part[place] for place in places] for part in (message.position, message.velocity, message.effort)
        )
        self.batch.append((message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec, q, dq, tau))
        if len(self.batch) >= self.rows:
            self.enqueue(self.batch)
            self.batch = []

    def enqueue(self, batch: Any) -> None:
        """Queue a batch for the sender, or None to end it."""
        if self.waiting.full():
            self.waiting.get_nowait()
            self.get_logger().error("The service is too slow or unreachable. The oldest batch was dropped.")
        self.waiting.put(batch)

    def send(self) -> None:
        """Send batches in order, each until it is answered, until the queue holds None."""
        sequence = 0
        while (batch := self.waiting.get()) is not None:
            t, q, dq, tau = zip(*batch, strict=True)
            while True:
                try:
                    ack = self.client.observe(self.model, self.stream_id, sequence, q, dq, tau, t=t)
                    self.get_logger().info(f"{ack.accepted} of {ack.rows} rows learnt, rejected: {ack.rejected}")
                except ServiceUnreachableError as error:
                    self.get_logger().warning(f"{error} Retrying.")
                    time.sleep(1.0)
                    continue
                except ApiError as error:
                    self.get_logger().error(f"Batch {sequence} was rejected: {error}")
                break
            sequence += 1

    def close(self) -> None:
        """Send the remaining rows and end the sender."""
        for last in ([self.batch] if self.batch else []) + [None]:
            self.enqueue(last)
        self.sender.join(10.0)
        self.client.close()


def main() -> None:
    """Run until Ctrl-C."""
    rclpy.init()
    node = Bridge()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
