#!/bin/sh
# Installs what `make bench` measures and compares with, on Debian or Ubuntu, as root: ROS 1 as the
# real-ROS tests have it, image messages, the peers, and the tools of the kernel's packet filter.
# Does nothing when all of it is there.
set -eu
cd "$(dirname "$0")/.."

packages="
socat haproxy nginx libnginx-mod-stream nftables conntrack iproute2 procps
libsensor-msgs-dev python3-sensor-msgs
"

is_installed() {
    dpkg-query -W -f '${Status}\n' "$1" 2>/dev/null | grep -q '^install ok installed$'
}

scripts/install-ros.sh

missing=""
for package in $packages; do
    is_installed "$package" || missing="$missing $package"
done
if [ -z "$missing" ]; then
    echo "install-bench: everything is there"
    exit 0
fi

if [ "$(id -u)" != 0 ]; then
    echo "install-bench: needs root to install:$missing" >&2
    exit 1
fi

# What is only compared with must not start by itself, now or later, and take port 80.
hold_back_services() {
    if [ ! -e /usr/sbin/policy-rc.d ]; then
        printf '#!/bin/sh\nexit 101\n' >/usr/sbin/policy-rc.d
        chmod 755 /usr/sbin/policy-rc.d
        trap 'rm -f /usr/sbin/policy-rc.d' EXIT
    fi
}

export DEBIAN_FRONTEND=noninteractive
apt="apt-get -o DPkg::Lock::Timeout=300 -o Acquire::Retries=3"
hold_back_services
$apt update -q
# shellcheck disable=SC2086
$apt install -q -y --no-install-recommends $missing
for service in haproxy nginx; do
    case " $missing " in *" $service "*) systemctl disable -q $service 2>/dev/null || true ;; esac
done
echo "install-bench: installed$missing"
