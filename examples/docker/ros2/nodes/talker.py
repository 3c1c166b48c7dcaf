"""Publishes twice a second, like any ROS 2 tutorial; the code knows nothing of the proxy."""

import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("talker")
publisher = node.create_publisher(String, "/chatter", 10)
node.create_timer(0.5, lambda: publisher.publish(String(data="hello from inside")))
rclpy.spin(node)
