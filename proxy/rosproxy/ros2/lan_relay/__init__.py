"""The LAN relay, a separate program. It shares `rosproxy.ros2.protocol.relay_*` with the proxy."""
