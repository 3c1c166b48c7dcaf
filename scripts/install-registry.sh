#!/usr/bin/env bash
# Build a container registry for `make release-check`: a Go module, pinned in scripts/registry.
# Prints the path of the program, which stays in the user's cache until a pin changes.
set -euo pipefail
cd "$(dirname "$0")/registry"
cache=${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy
program=$cache/registry-$(cat go.mod go.sum | sha256sum | cut -c1-12)
if [ ! -x "$program" ]; then
  echo "building a registry, in two minutes" >&2
  go=$(../go.sh)
  mkdir -p "$cache"
  # Moved at the end, so that an interrupted build leaves no incomplete program.
  CGO_ENABLED=0 "$go" build -trimpath -ldflags="-s -w" -o "$program.$$" \
    github.com/distribution/distribution/v3/cmd/registry
  mv "$program.$$" "$program"
fi
echo "$program"
