"""A ROS 2 node that runs an exported policy: an example, for you to change.

It was never run under ROS 2. Its syntax, and the fields of the messages that it uses,
are checked by tests/deploy/test_ros2.py against stand-ins for the message types.

    ros2 run YOUR_PACKAGE ros2_node --ros-args -p file:=fr3.rmp

It reads `/joint_states` and `/obstacles` (spheres as markers in the task's frame), and
sends torques to an effort controller. ROS 2 topics are no real-time channel: where your
robot has bindings of its own, run the loop on them, and let ROS bring the obstacles.
"""

import threading

import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from visualization_msgs.msg import Marker, MarkerArray

from rmp_mjx import deploy, runtime


class PolicyNode(Node):
    """Joint states in, efforts out."""

    def __init__(self):
        super().__init__("rmp_mjx")
        path = self.declare_parameter("file", "fr3.rmp").value
        self.deployed = deploy.load(path)
        self.names = self.deployed.metadata["robot"]["joints"]
        self.source = deploy.ObstacleSource(self.deployed.obstacles())
        table = {"point": [[0.0, 0.0, -0.112]], "normal": [[0.0, 0.0, 1.0]]}
        self.source.put("planes", **table)
        self.state, self.new = None, threading.Condition()
        self.create_subscription(JointState, "/joint_states", self.on_state, 1)
        self.create_subscription(MarkerArray, "/obstacles", self.on_obstacles, 1)
        self.efforts = self.create_publisher(
            Float64MultiArray, "/effort_controller/commands", 1
        )

    def on_state(self, message: JointState) -> None:
        """Keep the newest state, joints in the order of the file."""
        order = [message.name.index(name) for name in self.names]
        with self.new:
            self.state = (
                np.array(message.position)[order],
                np.array(message.velocity)[order],
            )
            self.new.notify()

    def on_obstacles(self, message: MarkerArray) -> None:
        """Spheres, measured now."""
        balls = [m for m in message.markers if m.type == Marker.SPHERE]
        centers = [[getattr(m.pose.position, axis) for axis in "xyz"] for m in balls]
        radii = [0.5 * m.scale.x for m in balls]
        self.source.put("spheres", center=np.reshape(centers, (-1, 3)), radius=radii)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Wait for the robot's next state."""
        with self.new:
            if not self.new.wait_for(lambda: self.state is not None, timeout=1.0):
                raise TimeoutError("no joint states for a second")
            state, self.state = self.state, None
        return state

    def write(self, tau: np.ndarray) -> None:
        """Send torques, gravity included."""
        self.efforts.publish(Float64MultiArray(data=tau.tolist()))


def main() -> None:
    """Visit four via points, then hold the arm."""
    runtime.configure()
    rclpy.init()
    node = PolicyNode()
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    points = [[0.35, -0.1, 0.1], [0.5, 0.1, 0.2], [0.35, 0.15, 0.1], [0.45, -0.15, 0.2]]
    task = deploy.ViaPoints(np.array(points))
    targets = deploy.PolicyTargets(node.deployed, task)
    backend = deploy.CallbackBackend(node.read, node.write, pace="robot")
    loop = deploy.Loop(node.deployed, backend, targets, node.source)
    report = loop.run(30.0, until=lambda: task.done)
    node.get_logger().info(f"{task.reached} of 4 visited: {report}")
    rclpy.shutdown()


if __name__ == "__main__":
    main()
