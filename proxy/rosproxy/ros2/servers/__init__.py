"""The sockets for ROS 2, and the order in which discovery is read."""
