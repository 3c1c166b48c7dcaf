#!/bin/sh
# Sourced by scripts that install Debian packages: find and install missing packages.

_is_installed() {
    dpkg-query -W -f '${Status}\n' "$1" 2>/dev/null | grep -q '^install ok installed$'
}

# need NAME PACKAGE…: sets $missing. Ends the script NAME if nothing is missing or installable.
need() {
    script=$1
    shift
    if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
        echo "$script: needs Debian or Ubuntu (apt-get is not here)" >&2
        exit 1
    fi
    missing=""
    for package; do
        _is_installed "$package" || missing="$missing $package"
    done
    if [ -z "$missing" ]; then
        echo "$script: everything is there"
        exit 0
    fi
    if [ "$(id -u)" != 0 ]; then
        echo "$script: needs root to install:$missing" >&2
        exit 1
    fi
}

# Installs $missing.
install_missing() {
    export DEBIAN_FRONTEND=noninteractive
    apt="apt-get -o DPkg::Lock::Timeout=300 -o Acquire::Retries=3"
    # A fresh machine has no package lists, and existing lists may be outdated.
    $apt update -q
    # shellcheck disable=SC2086
    $apt install -q -y --no-install-recommends $missing
}
