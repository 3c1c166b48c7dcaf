#!/usr/bin/env bash
# Build the test nodes of other client libraries (tests/clients), and install what that needs, on
# Debian or Ubuntu, as root. Kept in the user's cache until one of them changes: three minutes the
# first time on two cores, nothing after that.
set -euo pipefail
cd "$(dirname "$0")/.."
nodes=$PWD/tests/clients/nodes
built=${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy/clients
mkdir -p "$built"
exec 9>"$built/lock"
flock 9

packages=(
  ros-std-msgs ros-topic-tools-srvs ros-rosgraph-msgs ros-roscpp-msg libstd-msgs-dev libtopic-tools-dev
  sbcl roslisp cl-std-msgs cl-topic-tools gcc libc6-dev libssl-dev pkg-config
)
command -v npm >/dev/null || packages+=(nodejs npm)
# What the lock files were written by is the least that reads them.
[[ $(cargo --version 2>/dev/null) =~ ^cargo\ 1\.([0-9]+) ]] && [ "${BASH_REMATCH[1]}" -ge 85 ] ||
  packages+=("$(apt-cache show cargo-web >/dev/null 2>&1 && echo cargo-web || echo cargo)")
(
  . scripts/debian.sh
  need install-clients "${packages[@]}"
  install_missing
)

pins=$(find tests/clients/nodes scripts/install-clients.sh -type f -exec sha256sum {} + | sort | sha256sum)
if [ "$(cat "$built/pins" 2>/dev/null)" = "$pins" ]; then
  exit 0
fi
rm -f "$built/pins"

go=$(scripts/go.sh)
(cd "$nodes/goroslib" && CGO_ENABLED=0 "$go" build -trimpath -buildvcs=false -o "$built/goroslib" .)

# rust NAME: the packages with its messages are in ROSRUST_MSG_PATH or ROS_PACKAGE_PATH.
rust() {
  cargo build --quiet --locked --manifest-path "$nodes/$1/Cargo.toml" --target-dir "$built/target"
  mv "$built/target/debug/node-$1" "$built/$1"
}
messages=/usr/share/std_msgs:/usr/share/topic_tools
ROSRUST_MSG_PATH=$messages rust rosrust
ROS_PACKAGE_PATH=$messages rust roslibrust
rm -rf "$built/target"

for name in rosnodejs foxglove; do
  mkdir -p "$built/$name"
  cp "$nodes/$name"/* "$built/$name"
  (cd "$built/$name" && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error)
done

(cd "$built" && sbcl --non-interactive --no-userinit --load "$nodes/roslisp/node.lisp" \
  --eval '(node::build)' && mv node roslisp)
echo "$pins" >"$built/pins"
