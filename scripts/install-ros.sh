#!/bin/sh
# Installs what the real-ROS test layer (tests/ros) needs, on Debian or Ubuntu, as root:
# ROS 1 with its tools, the headers to compile the C++ test nodes, and the tools that
# lay out the network namespaces. Does nothing when all of it is there.
set -eu

packages="
ros-base topic-tools python3-topic-tools python3-actionlib python3-geometry-msgs
python3-rosbag python3-rosnode python3-rosparam python3-rosservice python3-rostopic
python3-roslaunch python3-rosmsg python3-std-srvs
libroscpp-dev libstd-msgs-dev libactionlib-dev libtopic-tools-dev
g++ pkg-config iproute2 nftables util-linux hostname
"

is_installed() {
    dpkg-query -W -f '${Status}\n' "$1" 2>/dev/null | grep -q '^install ok installed$'
}

if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
    echo "install-ros: needs Debian or Ubuntu (apt-get is not here)" >&2
    exit 1
fi

missing=""
for package in $packages; do
    is_installed "$package" || missing="$missing $package"
done
if [ -z "$missing" ]; then
    echo "install-ros: everything is there"
    exit 0
fi

if [ "$(id -u)" != 0 ]; then
    echo "install-ros: needs root to install:$missing" >&2
    exit 1
fi

export DEBIAN_FRONTEND=noninteractive
apt="apt-get -o DPkg::Lock::Timeout=300 -o Acquire::Retries=3"
# A fresh machine has no package lists; one that has them may hold outdated ones.
$apt update -q
# shellcheck disable=SC2086
$apt install -q -y --no-install-recommends $missing
echo "install-ros: installed$missing"
