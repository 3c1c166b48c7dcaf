"""ROS 1: rewrites the master API and the slave API, and relays TCPROS."""
