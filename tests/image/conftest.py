"""The images alone, and started by hand, without an operator.

Engine, images and robots come from `tests.docker`. Both layers may run at the same time.
"""

from tests.docker.conftest import (
    _engine,
    base_image,
    container_name,
    controller_image,
    proxy_image,
    robot,
    ros_image,
)

__all__ = [
    "_engine",
    "base_image",
    "container_name",
    "controller_image",
    "proxy_image",
    "robot",
    "ros_image",
]
