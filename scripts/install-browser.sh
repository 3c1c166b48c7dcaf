#!/bin/sh
# Installs what the tests of the live page (tests/browser) need besides ROS, on Debian, as root:
# Chromium, its WebDriver, and a font. Does nothing when all of it is there; on Ubuntu, whose
# Chromium is a snap, Chrome and its driver will do as well.
set -eu
. "$(dirname "$0")/debian.sh"

if command -v chromedriver >/dev/null && command -v google-chrome >/dev/null; then
    echo "install-browser: Chrome is there"
    exit 0
fi

need install-browser chromium chromium-driver fonts-dejavu-core
install_missing
echo "install-browser: installed$missing"
