"""Serves a live page of an operator for made-up robots with usual names, for pictures.

python -m tests.browser.robots PORT NODES

Mobile robots use ROS 1. Arms use ROS 2, in domain 0 or 7. Each of the three has a proxy. Of few
nodes, all belong to a single robot. The rates change each second. Some links are broken.
"""

from __future__ import annotations

import asyncio
import math
import sys
import time
from collections import Counter
from collections.abc import AsyncGenerator, Iterator
from functools import partial
from itertools import count, cycle
from typing import Any, NamedTuple

from rosproxy import __version__
from rosproxy.page.page_document import (
    BROKEN,
    CONTAINER,
    OK,
    ROBOT,
    Document,
    PageLink,
    PageNode,
    PageProxy,
    rounded,
)
from rosproxy_operator.common.merged_page import merged
from tests.browser.fleet import serve

HOST = "10.0.0.5"
BROKEN_SINCE = time.time() - 2 * 3600
"""The Unix time in seconds at which the proxies first saw the broken links."""


class Template(NamedTuple):
    """The nodes of a robot with their container, or "" for a node on the robot, and the topics.

    A topic: name, publisher, subscribers, messages a second, bytes of a message.
    """

    word: str
    nodes: dict[str, str]
    topics: tuple[tuple[str, str, tuple[str, ...], float, int], ...]


MOBILE = Template(
    "amr",
    {
        "lidar": "",
        "move_base": "navigation",
        "base_controller": "",
        "object_detector": "perception",
        "camera": "",
        "amcl": "navigation",
        "map_server": "navigation",
        "joystick": "",
        "rosbridge_websocket": "dashboard",
        "rosbag_record": "recorder",
    },
    (
        ("scan", "lidar", ("move_base", "amcl", "rosbag_record"), 20.0, 4_400),
        ("cmd_vel", "move_base", ("base_controller",), 10.0, 48),
        ("odom", "base_controller", ("move_base", "amcl", "rosbag_record"), 50.0, 720),
        ("camera/image_raw/compressed", "camera", ("object_detector",), 30.0, 84_000),
        ("detections", "object_detector", ("joystick", "rosbridge_websocket"), 8.0, 900),
        ("map", "map_server", ("base_controller", "rosbridge_websocket"), 0.0, 4_000_000),
        ("particlecloud", "amcl", ("joystick",), 5.0, 24_000),
        ("joy", "joystick", ("move_base",), 25.0, 96),
    ),
)
ARM = Template(
    "arm",
    {
        "controller_manager": "",
        "move_group": "moveit",
        "depth_camera": "",
        "pose_estimator": "vision",
        "gripper_driver": "",
        "cell_supervisor": "supervisor",
        "rosbag2_recorder": "recorder",
    },
    (
        ("joint_states", "controller_manager", ("move_group", "rosbag2_recorder"), 100.0, 480),
        ("joint_trajectory", "move_group", ("controller_manager",), 2.0, 9_000),
        ("depth/points", "depth_camera", ("pose_estimator",), 15.0, 620_000),
        ("object_pose", "pose_estimator", ("gripper_driver",), 15.0, 120),
        ("gripper/command", "cell_supervisor", ("gripper_driver",), 1.0, 60),
        ("gripper/state", "gripper_driver", ("cell_supervisor", "move_group"), 20.0, 90),
    ),
)
PROXIES = {"mobile": (MOBILE, ""), "cell-a": (ARM, "0"), "cell-b": (ARM, "7")}
"""The robots of each proxy, and the domain."""


class Robot(NamedTuple):
    """A robot with as many nodes as there is room for; ``number`` counts the robots of a proxy."""

    proxy: str
    number: int
    nodes: tuple[str, ...]

    @property
    def template(self) -> Template:
        return PROXIES[self.proxy][0]

    def key(self, node: str) -> str:
        """The key of a node: the name, or the domain and a GUID prefix."""
        if domain := PROXIES[self.proxy][1]:
            at = [*self.template.nodes].index(node)
            return f"{domain} 01.0f.{self.number:04x}.{at:04x}"
        return self.name(node)

    def name(self, node: str) -> str:
        return f"/{self.template.word}_{self.number:02}/{node}"

    def address(self, node: str) -> str:
        """The address of the machine or container of a node."""
        network = [*PROXIES].index(self.proxy)
        place = self.template.nodes[node]
        if not place:
            return f"192.168.{10 + network}.{100 + self.number}"
        at = sorted({*self.template.nodes.values()}).index(place)
        return f"172.{18 + network}.{self.number}.{1 + at}"


def robots(nodes: int) -> Iterator[Robot]:
    """Robots with ``nodes`` nodes in all."""
    numbers = {name: count(1) for name in PROXIES}
    for proxy in cycle(PROXIES):
        names = tuple(PROXIES[proxy][0].nodes)[:nodes]
        yield Robot(proxy, next(numbers[proxy]), names)
        nodes -= len(names)
        if not nodes:
            return


def documents(nodes: int, second: int) -> dict[str, Document | str]:
    """The documents of the proxies of some robots at a second."""
    fleet = [*robots(nodes)]
    used = {robot.proxy for robot in fleet}
    return {
        name: _document(name, [r for r in fleet if r.proxy == name], second)
        for name in PROXIES
        if name in used
    }


def _document(proxy: str, fleet: list[Robot], second: int) -> Document:
    ports = "11412-11475, 31 used"
    domain = PROXIES[proxy][1]
    version = f"ROS 2, domain {domain}" if domain else "ROS 1"
    nodes = {"rosproxy": PageNode("host", "proxy", "rosproxy", ports=ports, detail=version)}
    if not PROXIES[proxy][1]:
        nodes["master"] = PageNode(ROBOT, "master", "master", address="http://192.168.10.2:11311/")
    nodes |= {robot.key(name): _node(robot, name) for robot in fleet for name in robot.nodes}
    links = [link for robot in fleet for link in _links(robot, second)]
    if PROXIES[proxy][1]:
        shares = Counter(link.target for link in links if link.port)
        links = [_of_ros2(link, shares[link.target]) for link in links]
    proxy_itself = PageProxy("workstation", "http://192.168.10.2:11311")
    return Document(nodes, {link.key: link for link in links}, proxy=proxy_itself)


def _node(robot: Robot, name: str) -> PageNode:
    place = robot.template.nodes[name]
    lane = CONTAINER if place else ROBOT
    address = robot.address(name)
    port = 35_000 + [*robot.template.nodes].index(name)
    if not PROXIES[robot.proxy][1]:
        return PageNode(lane, address=f"{address}:{port}" if place else f"http://{address}:{port}/")
    detail = f"participant {robot.key(name).partition(' ')[2]}"
    return PageNode(lane, "participant", robot.name(name), address=address, detail=detail)


def places(nodes: int) -> dict[str, str]:
    """The names of the containers by address."""
    return {
        robot.address(name): f"{place}-{robot.number}"
        for robot in robots(nodes)
        for name in robot.nodes
        if (place := robot.template.nodes[name])
    }


def _links(robot: Robot, second: int) -> Iterator[PageLink]:
    """The topics between the nodes that the robot has."""
    of_node = robot.template.nodes
    for topic, publisher, subscribers, hertz, size in robot.template.topics:
        for subscriber in subscribers:
            if not {publisher, subscriber} <= {*robot.nodes} or not (
                of_node[publisher] or of_node[subscriber]
            ):
                continue
            name = f"/{robot.template.word}_{robot.number:02}/{topic}"
            ends = robot.key(publisher), robot.key(subscriber)
            wave = 1 + 0.3 * math.sin(second / 4 + len(topic))
            at = 11_412 + (3 * robot.number + len(topic)) % 64
            is_direct = bool(of_node[publisher] and of_node[subscriber])
            link = PageLink(
                "topic",
                name,
                *ends,
                carried="direct" if is_direct else "splice",
                port=None if is_direct else at,
                rate=rounded(hertz * size * wave),
                hz=rounded(hertz * wave),
                since=None if hertz else time.time() - 900,
                flows=hertz > 0,
                state=OK,
            )
            yield _broken(robot, topic, subscriber, link)


def _broken(robot: Robot, topic: str, subscriber: str, link: PageLink) -> PageLink:
    """The link, or the link broken: for the first robots, and for each twentieth."""
    if robot.number % 20 != 1:
        return link
    text = fix = ""
    if (topic, subscriber) == ("detections", "joystick"):
        machine = robot.name(subscriber)
        text = f"{machine} has not connected to {HOST}:{link.port}"
        fix = f"test on the machine of {machine}: nc -vz {HOST} {link.port}. If nc fails, let the "
        fix += "firewalls on the way accept the port"
    elif (topic, robot.proxy) == ("object_pose", "cell-b"):
        text = "reliability differs: the publisher offers BEST_EFFORT, the subscription requests "
        text += "RELIABLE"
        fix = "make the publisher RELIABLE, or the subscription BEST_EFFORT"
    if not text:
        return link
    return PageLink(
        "topic", link.name, link.source, link.target, port=link.port, state=BROKEN, text=text,
        fix=fix, wrong_since=BROKEN_SINCE,
    )  # fmt: skip


def _of_ros2(link: PageLink, shared: int) -> PageLink:
    """The link with the measures of ROS 2: datagrams, shared by the links to a participant."""
    if link.state == BROKEN:
        return link
    if not link.port:
        return PageLink("topic", link.name, link.source, link.target, carried="direct", state=OK)
    return PageLink(
        "topic", link.name, link.source, link.target, carried="copy", port=link.port,
        rate=link.rate, datagrams=link.hz, shared=shared if shared > 1 else 0,
        flows=shared == 1, state=OK,
    )  # fmt: skip


async def document_each_second(nodes: int) -> AsyncGenerator[dict[str, Any]]:
    """Yield the merged document of each second."""
    for second in count():
        yield merged(documents(nodes, second), __version__, "docker logs {}".format, places(nodes))
        await asyncio.sleep(1.0)


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1]), partial(document_each_second, int(sys.argv[2]))))
