# A machine with ROS 2 (Jazzy and Kilted, on Fast DDS) and with Cyclone DDS, from PyPI, each in an
# environment of its own, and with the nodes of tests/ros2. The context is tests/ros2.
ARG BASE_IMAGE
FROM ${BASE_IMAGE}
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv libpython3.11 iproute2 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
COPY environments/*.txt /environments/
RUN for name in jazzy kilted cyclone; do \
      python3 -m venv "/opt/$name" \
      && "/opt/$name/bin/pip" install --quiet --no-cache-dir --disable-pip-version-check \
           --only-binary :all: --no-deps --require-hashes --requirement "/environments/$name.txt" \
      || exit 1; \
    done
COPY nodes /nodes
# As images of ROS 2 have it, whose entry point makes Python find rclpy.
ENV PYTHONUNBUFFERED=1 ROS_DISTRO=jazzy PATH=/opt/jazzy/bin:$PATH
