#!/usr/bin/env bash
# Make a bare Debian image without a registry: debootstrap, then docker import.
#   scripts/base-image.sh NAME
# Kept: nothing happens when the image exists already. ROSPROXY_MIRROR names another
# Debian mirror. Needs root, debootstrap and a running engine.
set -euo pipefail
name=$1
suite=bookworm
mirror=${ROSPROXY_MIRROR:-http://deb.debian.org/debian}

if docker image inspect "$name" >/dev/null 2>&1; then
  exit 0
fi
tree=$(mktemp -d)
trap 'rm -rf "$tree"' EXIT
debootstrap --variant=minbase --include=ca-certificates "$suite" "$tree" "$mirror" >&2

# If a company's certificates are necessary for the package index, pip inside the image
# needs these certificates, too.
changes=()
bundle=/etc/ssl/certs/ca-certificates.crt
if [ -n "${PIP_CERT:-${SSL_CERT_FILE:-}}" ]; then
  cp "$bundle" "$tree$bundle"
  changes=(--change "ENV PIP_CERT=$bundle" --change "ENV SSL_CERT_FILE=$bundle")
fi
[ ! -e /etc/pip.conf ] || cp /etc/pip.conf "$tree/etc/pip.conf"
rm -rf "$tree"/var/cache/apt/archives/*.deb "$tree"/var/lib/apt/lists/*
tar -C "$tree" -c . | docker import "${changes[@]}" - "$name" >&2
