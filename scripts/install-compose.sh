#!/usr/bin/env bash
# Install Docker Compose for the tests of the examples. Needs root, and
# scripts/install-docker.sh before. An installed Compose stays.
set -euo pipefail

# Version 2, the plug-in that users have; or version 1 if version 2 is not available.
compose() {
  docker compose version >/dev/null 2>&1 ||
    { command -v docker-compose >/dev/null && ! command -v go >/dev/null; }
}

packages() {
  DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends "$@"
}

# Compose goes by different names in Docker's archive, in Ubuntu and in Debian. Debian 12 has
# version 1, with which the tests run too; version 2 is built there if Go is at hand.
install_compose() {
  local package
  for package in docker-compose-plugin docker-compose-v2 docker-compose; do
    if packages "$package" 2>/dev/null && compose; then
      return
    fi
  done
  build_compose || command -v docker-compose >/dev/null
}

build_compose() {
  local version=v2.40.3 module=github.com/docker/compose/v2
  command -v go >/dev/null || return 1
  # In a separate module: Compose's module has directives that `go install` refuses.
  (
    cd "$(mktemp -d)" &&
      trap 'rm -rf "$PWD"' EXIT &&
      go mod init compose &&
      go get "$module/cmd@$version" &&
      CGO_ENABLED=0 go build -trimpath -o docker-compose \
        -ldflags="-s -w -X $module/internal.Version=$version" "$module/cmd" &&
      install -D -t /usr/local/lib/docker/cli-plugins docker-compose
  ) && docker compose version
}

if compose; then
  exit 0
fi
apt-get update -q
install_compose
