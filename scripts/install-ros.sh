#!/bin/sh
# Installs the requirements of the real-ROS test layer (tests/ros), on Debian or Ubuntu, as root:
# ROS 1 with tools, the headers to compile the C++ test nodes, and the tools for network
# namespaces. Does nothing if all are installed.
set -eu
. "$(dirname "$0")/debian.sh"

need install-ros \
    ros-base topic-tools python3-topic-tools python3-actionlib python3-geometry-msgs \
    python3-rosbag python3-rosnode python3-rosparam python3-rosservice python3-rostopic \
    python3-roslaunch python3-rosmsg python3-std-srvs \
    libroscpp-dev libstd-msgs-dev libactionlib-dev libtopic-tools-dev \
    g++ pkg-config iproute2 nftables conntrack libcap2-bin procps util-linux hostname
install_missing
echo "install-ros: installed$missing"
