"""The node in a labelled pod that sends each message back, with the name of the cluster's node."""

import os
import sys

import rclpy
from std_msgs.msg import String

if not os.environ.get("ROS_STATIC_PEERS"):
    sys.exit("this pod was not wired at admission: the operator's webhook did not answer")
print("the proxy is", os.environ["ROS_STATIC_PEERS"], flush=True)
rclpy.init()
node = rclpy.create_node(os.environ["NODE_NAME"])
answers = node.create_publisher(String, "~/pong", 10)


def answer(question):
    answers.publish(String(data="%s %s" % (question.data, os.environ["ON_NODE"])))


node.create_subscription(String, "~/ping", answer, 10)
rclpy.spin(node)
