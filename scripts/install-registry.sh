#!/usr/bin/env bash
# Build a container registry, to which `make release-check` pushes: a Go module, pinned in
# scripts/registry. Prints its path. Kept in the user's cache until a pin changes.
set -euo pipefail
cd "$(dirname "$0")/registry"
cache=${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy
program=$cache/registry-$(cat go.mod go.sum | sha256sum | cut -c1-12)
if [ ! -x "$program" ]; then
  echo "building a registry, in two minutes" >&2
  go=$(../go.sh)
  mkdir -p "$cache"
  # Moved when it is whole: a build that is broken off leaves nothing that looks like one.
  CGO_ENABLED=0 "$go" build -trimpath -ldflags="-s -w" -o "$program.$$" \
    github.com/distribution/distribution/v3/cmd/registry
  mv "$program.$$" "$program"
fi
echo "$program"
