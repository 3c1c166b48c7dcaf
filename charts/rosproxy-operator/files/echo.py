"""The inside node, in a labelled pod: sends each message back."""

import os
import sys

import rospy
from std_msgs.msg import String

if "ROS_MASTER_URI" not in os.environ or "localhost" in os.environ["ROS_MASTER_URI"]:
    sys.exit("this pod was not wired at admission: the operator's webhook did not answer")
print("the master is", os.environ["ROS_MASTER_URI"], flush=True)
rospy.init_node(os.environ["NODE_NAME"], disable_signals=True)
answers = rospy.Publisher("~pong", String, queue_size=10)
rospy.Subscriber("~ping", String, answers.publish)
rospy.spin()
