"""The ROS 2 example: its syntax, and the message fields that it uses.

The stand-ins have the fields of the message definitions and no others. Nothing here
says that the node works under ROS 2.
"""

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest


class Node:
    file = ""

    def __init__(self, name):
        self.published, self.subscribed = [], {}

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=Node.file)

    def create_subscription(self, kind, topic, callback, depth):
        self.subscribed[topic] = callback

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.published.append)


class JointState:
    __slots__ = ("effort", "header", "name", "position", "velocity")


class Float64MultiArray:
    __slots__ = ("data", "layout")

    def __init__(self, data):
        self.data = data


class Marker:
    SPHERE = 2
    __slots__ = ("color", "header", "id", "ns", "pose", "scale", "type")


class MarkerArray:
    __slots__ = ("markers",)


@pytest.fixture
def module(root, exported, monkeypatch):
    Node.file = str(exported)
    contents = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "sensor_msgs.msg": {"JointState": JointState},
        "std_msgs.msg": {"Float64MultiArray": Float64MultiArray},
        "visualization_msgs.msg": {"Marker": Marker, "MarkerArray": MarkerArray},
    }
    for name, members in contents.items():
        stub = ModuleType(name)
        vars(stub).update(members)
        monkeypatch.setitem(sys.modules, name, stub)
    path = root / "docs/examples/ros2_node.py"
    assert len(path.read_text().splitlines()) < 100
    spec = importlib.util.spec_from_file_location("ros2_node", path)
    assert spec is not None and spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


def test_messages_become_states_and_obstacles_and_torques_a_message(module):
    node = module.PolicyNode()
    state = JointState()
    state.name = [*reversed(node.names), "finger"]
    state.position, state.velocity = np.arange(8.0), -np.arange(8.0)
    node.subscribed["/joint_states"](state)
    q, qd = node.read()
    assert q.tolist() == [6, 5, 4, 3, 2, 1, 0] and qd.tolist() == (-q).tolist()
    ball, box = Marker(), Marker()
    ball.type, box.type = Marker.SPHERE, 1
    ball.pose = SimpleNamespace(position=SimpleNamespace(x=0.4, y=0.1, z=0.2))
    ball.scale = SimpleNamespace(x=0.1, y=0.1, z=0.1)
    several = MarkerArray()
    several.markers = [ball, box]
    node.subscribed["/obstacles"](several)
    spheres = node.source.get().slots["spheres"]
    assert spheres["active"].sum() == 1
    np.testing.assert_allclose(spheres["center"][0], [0.4, 0.1, 0.2])
    assert spheres["radius"][0] == np.float32(0.05)
    several.markers = []
    node.subscribed["/obstacles"](several)
    assert not node.source.get().slots["spheres"]["active"].any()
    node.write(q)
    assert node.published[0].data == q.tolist()
