"""Sockets, HTTP, names and addresses, for ROS 1, ROS 2 and rmw_zenoh."""
