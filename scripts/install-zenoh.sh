#!/usr/bin/env bash
# Installs the requirements of the zenoh layer (tests/zenoh), on Debian or Ubuntu, as root: three
# versions of the zenoh library and zenoh-ros2-sdk, each in a separate environment in the user's
# cache, and the tools for network namespaces. Does nothing if all are installed.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/debian.sh

(need install-zenoh iproute2 nftables procps util-linux hostname && install_missing)

environments=${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy/zenoh
for pins in tests/zenoh/environments/*.txt; do
  name=$(basename "$pins" .txt)
  target=$environments/$name
  cmp -s "$pins" "$target/pins" && continue
  rm -rf "$target"
  "${PYTHON:-.venv/bin/python}" -m venv "$target"
  "$target/bin/python" -m pip install --quiet --disable-pip-version-check \
    --only-binary :all: --no-deps --require-hashes --requirement "$pins"
  cp "$pins" "$target/pins"
  echo "install-zenoh: installed $name in $target"
done
