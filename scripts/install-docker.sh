#!/usr/bin/env bash
# Install a Docker engine, and the tools with which the tests make images and other machines.
# An installed engine, Debian's or not, stays. Needs root.
set -euo pipefail

declare -A package_of=(
  [dockerd]=docker.io [docker]=docker.io [iptables]=iptables [ip]=iproute2
  [nsenter]=util-linux [debootstrap]=debootstrap [conntrack]=conntrack
)
missing=()
for command in "${!package_of[@]}"; do
  command -v "$command" >/dev/null || missing+=("${package_of[$command]}")
done
[ -e /usr/share/keyrings/debian-archive-keyring.gpg ] || missing+=(debian-archive-keyring)

packages() {
  DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends "$@"
}

# Newer releases have the command line in a separate package.
command_line() {
  command -v docker >/dev/null || packages docker-cli
}

if [ "${#missing[@]}" = 0 ]; then
  exit 0
fi
apt-get update -q
packages "${missing[@]}"
command_line
