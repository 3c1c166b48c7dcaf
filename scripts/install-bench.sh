#!/bin/sh
# Installs socat, which `make bench` compares with. Where that can't be done it says so.
set -eu
if command -v socat >/dev/null; then
    exit 0
fi
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    echo "install-bench: only root on Debian or Ubuntu can install socat here" >&2
    exit 0
fi
apt="env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=300"
{ $apt update -qq && $apt install -qq -y --no-install-recommends socat; } >&2 ||
    echo "install-bench: socat could not be installed" >&2
