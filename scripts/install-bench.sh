#!/bin/sh
# Installs the requirements of `make bench`, on Debian or Ubuntu, as root: ROS 1, ROS 2 and zenoh of
# the tests, image messages, the other relays, the tools of the kernel's packet filter, and the
# programs of a Kubernetes cluster. Does nothing if all are installed.
set -eu
cd "$(dirname "$0")/.."
. scripts/debian.sh

scripts/install-ros.sh
scripts/install-ros2.sh
scripts/install-zenoh.sh
scripts/install-browser.sh
scripts/install-kubernetes.sh
need install-bench \
    socat haproxy nginx libnginx-mod-stream nftables conntrack iproute2 procps \
    libsensor-msgs-dev python3-sensor-msgs

# The other relays must not start by themselves, now or later, and take port 80.
hold_back_services() {
    if [ ! -e /usr/sbin/policy-rc.d ]; then
        printf '#!/bin/sh\nexit 101\n' >/usr/sbin/policy-rc.d
        chmod 755 /usr/sbin/policy-rc.d
        trap 'rm -f /usr/sbin/policy-rc.d' EXIT
    fi
}

hold_back_services
install_missing
for service in haproxy nginx; do
    case " $missing " in *" $service "*) systemctl disable -q $service 2>/dev/null || true ;; esac
done
echo "install-bench: installed$missing"
