# A machine with ROS 1, from Debian's packages: the nodes inside and the robot outside.
ARG BASE_IMAGE
FROM ${BASE_IMAGE}
RUN apt-get update \
    && apt-get install -y --no-install-recommends ros-base \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
ENV ROS_LOG_DIR=/tmp/ros PYTHONUNBUFFERED=1
