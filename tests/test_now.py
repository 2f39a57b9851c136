"""Navigation at a time: offsets, fields of ROS against scipy, sentences that the reader of NMEA reads back."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxnav
from jaxnav.maths.units import DEG
from jaxnav.now import Now

DOC = Path(__file__).parents[1] / "docs" / "stream.md"
NED_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU = np.diag([1.0, -1.0, -1.0])


def example(**changes) -> Now:
    """A vehicle that heads north-east, climbs, banks and yaws."""
    rng = np.random.default_rng(3)
    rph, root = np.array([0.2, 0.1, 45 * DEG]), rng.normal(size=(9, 9))
    C = NED_ENU @ Rotation.from_euler("ZYX", rph[::-1]).as_matrix()  # FRD -> ENU
    P = root @ root.T
    lla = np.array([48.1 * DEG, 11.6 * DEG, 520.0])
    return Now(
        3600.25, lla, C @ [12.0, 0.3, -0.1], rph, np.sqrt(np.diag(P)), np.ones(3), True,
        Rotation.from_matrix(C).as_quat()[[3, 0, 1, 2]], np.array([0.01, -0.02, 0.3]), np.full(3, 1e-4), P,
    )._replace(**changes)  # fmt: skip


def test_the_quaternion_of_ros_turns_flu_to_enu():
    now = example()
    found = now.odometry(now.lla - [100 / 6.36e6, 0.0, 5.0])
    turn = Rotation.from_quat(found.orientation)
    np.testing.assert_allclose(turn.apply(found.linear), now.vel, atol=1e-12)
    np.testing.assert_allclose(found.linear, [12.0, -0.3, 0.1], atol=1e-12)  # forward, left, up
    np.testing.assert_allclose(found.angular, [0.01, 0.02, -0.3], atol=1e-15)
    np.testing.assert_allclose(found.position, [0.0, 100.0, 5.0], atol=0.2)
    level = example(rph=np.zeros(3), q=np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0]))  # heads north
    ahead = Rotation.from_quat(level.odometry(level.lla).orientation).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(ahead, [0.0, 1.0, 0.0], atol=1e-12)


def test_covariances_of_ros_are_those_of_samples():
    """Errors drawn from P: positions and turns about ENU, velocities in the body that has the turn's error."""
    now, count = example(), 200_000
    P = 1e-6 * now.P
    now = now._replace(P=P)
    found = now.odometry(now.lla)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(9), P, count)
    pose = draws[:, [0, 1, 2, 6, 7, 8]]
    np.testing.assert_allclose(found.pose_covariance.reshape(6, 6), np.cov(pose.T), atol=0.02 * P.max())
    C = Rotation.from_quat(found.orientation)
    wrong = Rotation.from_rotvec(draws[:, 6:]) * C
    velocity = wrong.inv().apply(now.vel + draws[:, 3:6])
    twist = found.twist_covariance.reshape(6, 6)
    seen = np.cov(velocity.T)
    np.testing.assert_allclose(twist[:3, :3], seen, atol=0.02 * seen.max())
    np.testing.assert_allclose(twist[3:, 3:], 1e-8 * np.eye(3))


@pytest.mark.parametrize(
    ("lat", "lon", "text"),
    [
        (48.1, 11.6, "4806.0000000,N,01136.0000000,E"),
        (-0.5, -170.25, "0030.0000000,S,17015.0000000,W"),
        (59.9999999999, 190.0, "6000.0000000,N,17000.0000000,W"),  # no sixty minutes; within half a turn
    ],
)
def test_a_sentence_has_degrees_and_minutes(lat, lon, text):
    now = example(lla=np.array([lat * DEG, lon * DEG, 520.0]))
    said = now.gga(quality=4, separation=46.0)
    assert said.startswith(f"$INGGA,010000.25,{text},4,,,474.000,M,46.000,M,,*")
    body, check = said[1:].split("*")
    assert int(check, 16) == int(np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8)))
    assert now.gga(time=86399.999).startswith("$INGGA,000000.00,")  # no 60 s


def test_a_sentence_is_read_back_by_another_library():
    parsed = pytest.importorskip("pynmeagps").NMEAReader.parse(example().gga() + "\r\n")
    assert parsed.lat == pytest.approx(48.1, abs=1e-9) and parsed.lon == pytest.approx(11.6, abs=1e-9)
    assert parsed.alt == 520.0 and parsed.quality == 6


class Message(SimpleNamespace):
    """A message of ROS: fields are there as soon as they are asked for."""

    def __getattr__(self, name):
        setattr(self, name, Message())
        return self.__dict__[name]


def test_the_node_of_the_docs_publishes_odometry():
    sent, pushed, now = [], [], example()
    code = next(c for c in re.findall(r"```python\n(.*?)```", DOC.read_text(), re.DOTALL) if "class Navigator" in c)

    class Node:
        def __init__(self, name):
            self.name, self.taken = name, {}

        def create_publisher(self, kind, topic, depth):
            return SimpleNamespace(publish=sent.append)

        def create_subscription(self, kind, topic, call, depth):
            self.taken[topic] = call

    live = SimpleNamespace(
        push_imu=lambda *row: pushed.append(row) or (now if len(pushed) > 1 else None),
        push=lambda *row: pushed.append(row),
    )
    messages = SimpleNamespace(Odometry=Message, Imu=Message, NavSatFix=Message)
    names = {
        "rclpy": SimpleNamespace(node=SimpleNamespace(Node=Node)), "jaxnav": jaxnav, "np": np,
        "nav_msgs": SimpleNamespace(msg=messages), "sensor_msgs": SimpleNamespace(msg=messages),
    }  # fmt: skip
    exec(compile(code, str(DOC), "exec"), names)
    node = names["Navigator"](live)
    stamp = SimpleNamespace(sec=7, nanosec=250_000_000)
    vector = lambda x, y, z: SimpleNamespace(x=x, y=y, z=z)
    sample = Message(
        header=SimpleNamespace(stamp=stamp), linear_acceleration=vector(0.1, 0.2, 9.8),
        angular_velocity=vector(0.01, 0.02, 0.03),
    )  # fmt: skip
    node.taken["imu"](sample)
    assert pushed == [(7.25, (0.01, -0.02, -0.03), (0.1, -0.2, -9.8))] and sent == []
    node.taken["imu"](sample)
    (out,) = sent
    assert out.header.stamp is stamp and out.child_frame_id == "base_link" and out.pose.pose.position.x == 0.0
    quaternion = out.pose.pose.orientation
    np.testing.assert_allclose(
        [quaternion.x, quaternion.y, quaternion.z, quaternion.w], now.odometry(now.lla).orientation
    )
    assert out.twist.twist.linear.x == pytest.approx(12.0) and out.twist.covariance.shape == (36,)
    fix = Message(header=SimpleNamespace(stamp=stamp), latitude=48.0, longitude=11.0, altitude=500.0,
                  position_covariance=[4.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 16.0])  # fmt: skip
    node.taken["fix"](fix)
    name, t, place, sd = pushed[-1]
    assert (name, t) == ("position", 7.25) and place == (np.radians(48.0), np.radians(11.0), 500.0)
    np.testing.assert_array_equal(sd, [2.0, 3.0, 4.0])
