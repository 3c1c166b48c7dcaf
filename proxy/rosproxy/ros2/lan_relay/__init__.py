"""The LAN relay, a program of its own. It and the proxy share `rosproxy.ros2.protocol.relay_*`."""
