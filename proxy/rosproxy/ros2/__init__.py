"""ROS 2: nodes discover each other by DDS, and the proxy rewrites this discovery."""
