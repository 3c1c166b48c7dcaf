"""An rclpy node that executes the commands of `talking`.

Runs with the Python of a ROS 2 distribution. Messages are serialized, so that the times do not
include Python's conversion.
"""

from __future__ import annotations

import sys
import threading
from functools import partial

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from talking import TOPICS, Talker, serve


def main(name: str, peer: str) -> None:
    rclpy.init(args=[])
    node = rclpy.create_node(name)
    qos = QoSProfile(depth=1000)
    publishers = {topic: node.create_publisher(String, f"/{name}/{topic}", qos) for topic in TOPICS}
    talker = Talker(
        lambda topic, data: publishers[topic].publish(data),
        lambda: all(publisher.get_subscription_count() for publisher in publishers.values()),
    )
    for topic in TOPICS:
        take = partial(talker.take, topic)
        node.create_subscription(String, f"/{peer}/{topic}", take, qos, raw=True)

    def spin() -> None:
        try:
            rclpy.spin(node)
        except ExternalShutdownException:
            return

    threading.Thread(target=spin, daemon=True).start()
    serve(talker)


if __name__ == "__main__":
    main(*sys.argv[1:])
