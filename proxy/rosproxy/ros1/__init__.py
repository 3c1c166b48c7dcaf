"""ROS 1: its master API, slave API and TCPROS, rewritten and relayed."""
