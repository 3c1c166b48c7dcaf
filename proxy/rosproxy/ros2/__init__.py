"""ROS 2: nodes that find each other by DDS discovery, and how it is rewritten on its way."""
