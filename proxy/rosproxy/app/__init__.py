"""The running proxy: the process, the stacks for ROS 1, ROS 2 and rmw_zenoh, and the self-check."""
