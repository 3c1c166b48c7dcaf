"""rosproxy: a transparent proxy between isolated networks for ROS 1."""

__version__ = "0.1.0"
