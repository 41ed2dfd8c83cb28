"""A ROS 2 node that lets a model learn from `sensor_msgs/JointState`: an example, no part of the package.

    python docs/examples/ros2_bridge.py --ros-args -p model:=my-panda -p topic:=/joint_states

It needs rclpy of your ROS 2 and `pip install lipserve-client`. Efforts have to be joint torques, N·m, of the
model's convention. Accelerations are left to the service, which derives them from velocities and times.
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

WAITING = 100
"""Batches that wait for the service at most: beyond it the oldest are dropped, and that is said."""


class Bridge(Node):
    """Gathers rows in the callback, which must not wait, and sends them from a thread of its own."""

    def __init__(self) -> None:
        super().__init__("lipserve_bridge")
        given = {"model": "", "url": "", "topic": "/joint_states", "rows": 100}
        for name, default in given.items():
            self.declare_parameter(name, default)
        self.model, url, topic, self.rows = (self.get_parameter(name).value for name in given)
        self.client = Client(url)  # where empty, that of LIPSERVE_URL
        serving = self.client.model(self.model).serving_version
        self.joints = self.client.version(self.model, serving).joint_names
        # a sequence is a batch's identity for good: each run of the node is a stream of its own
        self.stream_id = f"ros2-{time.time_ns()}"
        self.batch: list[tuple[float, list[float], list[float], list[float]]] = []
        self.waiting: queue.Queue[Any] = queue.Queue(WAITING)
        self.sender = threading.Thread(target=self.send, daemon=True)
        self.sender.start()
        self.create_subscription(JointState, topic, self.take, 100)

    def take(self, message: JointState) -> None:
        """Keep a row; messages that lack a joint of the model, or its velocity or effort, are not for it."""
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
            self.hand_over(self.batch)
            self.batch = []

    def hand_over(self, batch: Any) -> None:
        """Let the sender have a batch, or None, after which it ends."""
        if self.waiting.full():
            self.waiting.get_nowait()
            self.get_logger().error("the service is too slow or gone: the oldest batch is dropped")
        self.waiting.put(batch)

    def send(self) -> None:
        """Send batch after batch, each until it is answered; None ends it."""
        sequence = 0
        while (batch := self.waiting.get()) is not None:
            t, q, dq, tau = zip(*batch, strict=True)
            while True:
                try:
                    said = self.client.observe(self.model, self.stream_id, sequence, q, dq, tau, t=t)
                    self.get_logger().info(f"{said.accepted} of {said.rows} rows learnt, kept out: {said.rejected}")
                except ServiceUnreachableError as error:
                    self.get_logger().warning(f"{error}: trying again")
                    time.sleep(1.0)
                    continue
                except ApiError as error:
                    self.get_logger().error(f"batch {sequence} is refused: {error}")
                break
            sequence += 1

    def close(self) -> None:
        """Send what is left."""
        for last in ([self.batch] if self.batch else []) + [None]:
            self.hand_over(last)
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
