#!/usr/bin/env bash
# Installs the requirements of the ROS 2 layer (tests/ros2), on Debian or Ubuntu, as root: two
# distributions of ROS 2 and another vendor's DDS, each in a separate environment in the user's cache,
# and the tools for network namespaces. Arguments select environments. Does nothing if all are
# installed.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/debian.sh

(need install-ros2 iproute2 nftables conntrack procps util-linux hostname && install_missing)

environments=${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy/ros2
[[ $# -gt 0 ]] || set -- jazzy kilted cyclone
for name in "$@"; do
  pins=tests/ros2/environments/$name.txt
  target=$environments/$name
  cmp -s "$pins" "$target/pins" && continue
  rm -rf "$target"
  "${PYTHON:-.venv/bin/python}" -m venv "$target"
  "$target/bin/python" -m pip install --quiet --disable-pip-version-check \
    --only-binary :all: --no-deps --require-hashes --requirement "$pins"
  cp "$pins" "$target/pins"
  echo "install-ros2: installed $name in $target"
done
