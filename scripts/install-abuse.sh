#!/usr/bin/env bash
# Installs what the layer abuse (tests/abuse) needs, on Debian or Ubuntu, as root: the tools for its
# network namespaces and for the kernel plane. Does nothing where both are there.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/debian.sh

command -v ip >/dev/null && command -v nft >/dev/null && exit
need install-abuse iproute2 nftables
install_missing
