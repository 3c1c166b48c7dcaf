"""The part of the proxy for rmw_zenoh, the ROS 2 middleware that is not DDS."""
