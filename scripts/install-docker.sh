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

compose() {
  docker compose version >/dev/null 2>&1 || command -v docker-compose >/dev/null
}

install() {
  DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends "$@"
}

# Newer releases have the command line in a package of its own.
install_command_line() {
  command -v docker >/dev/null || install docker-cli
}

# Compose goes by different names in Docker's archive, in Ubuntu and in Debian.
install_compose() {
  local package
  for package in docker-compose-plugin docker-compose-v2 docker-compose; do
    if install "$package" 2>/dev/null && compose; then
      return
    fi
  done
  echo "no package of Docker Compose found" >&2
  return 1
}

if [ "${#missing[@]}" = 0 ] && compose; then
  exit 0
fi
apt-get update -q
[ "${#missing[@]}" = 0 ] || install "${missing[@]}"
install_command_line
compose || install_compose
