"""Logs each received message."""

import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("listener")
log = node.get_logger()
node.create_subscription(String, "/command", lambda message: log.info(message.data), 10)
rclpy.spin(node)
