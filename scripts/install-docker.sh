#!/usr/bin/env bash
# Install a Docker engine, and what the tests make images and other machines with.
# An engine that is already there, Debian's or not, is left as it is. Needs root.
set -euo pipefail

declare -A package_of=(
  [dockerd]=docker.io [docker]=docker.io [iptables]=iptables [ip]=iproute2
  [nsenter]=util-linux [debootstrap]=debootstrap
)
missing=()
for command in "${!package_of[@]}"; do
  command -v "$command" >/dev/null || missing+=("${package_of[$command]}")
done
[ -e /usr/share/keyrings/debian-archive-keyring.gpg ] || missing+=(debian-archive-keyring)

# Version 2, the plug-in that users have; or version 1 where nothing else can be had.
compose() {
  docker compose version >/dev/null 2>&1 ||
    { command -v docker-compose >/dev/null && ! command -v go >/dev/null; }
}

packages() {
  DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends "$@"
}

# Newer releases have the command line in a package of its own.
command_line() {
  command -v docker >/dev/null || packages docker-cli
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
  # In a module of our own: Compose's has directives that keep `go install` from it.
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

if [ "${#missing[@]}" = 0 ] && compose; then
  exit 0
fi
apt-get update -q
[ "${#missing[@]}" = 0 ] || packages "${missing[@]}"
command_line
compose || install_compose
