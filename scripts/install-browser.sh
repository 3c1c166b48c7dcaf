#!/bin/sh
# Installs the requirements of the live page's tests (tests/browser) besides ROS, on Debian, as root:
# Chromium, its WebDriver, and a font. Does nothing if all are installed. On Ubuntu, where Chromium is
# a snap, install Chrome and chromedriver instead.
set -eu
. "$(dirname "$0")/debian.sh"

if command -v chromedriver >/dev/null && command -v google-chrome >/dev/null; then
    echo "install-browser: Chrome is there"
    exit 0
fi

need install-browser chromium chromium-driver fonts-dejavu-core
install_missing
echo "install-browser: installed$missing"
