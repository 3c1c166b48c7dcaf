#!/bin/sh
# Installs socat, which `make bench` compares with; where that fails, it runs without.
set -eu
command -v socat >/dev/null && exit 0
export DEBIAN_FRONTEND=noninteractive
apt="apt-get -o DPkg::Lock::Timeout=300"
{ [ "$(id -u)" = 0 ] && $apt update -qq && $apt install -qq -y --no-install-recommends socat; } >&2 ||
    echo "install-bench: can't install socat: that needs root on Debian or Ubuntu, and a mirror" >&2
