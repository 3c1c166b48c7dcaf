#!/usr/bin/env bash
# Installs the requirements of the layer abuse (tests/abuse), on Debian or Ubuntu, as root: the tools
# for network namespaces and for the kernel plane. Does nothing if both are installed.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/debian.sh

command -v ip >/dev/null && command -v nft >/dev/null && exit
need install-abuse iproute2 nftables
install_missing
