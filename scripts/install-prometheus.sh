#!/bin/sh
# Installs Prometheus and promtool, with which the dashboard and the alerts are tested, on Debian or
# Ubuntu, as root. Does nothing when they are there.
set -eu
. "$(dirname "$0")/debian.sh"

need install-prometheus prometheus
# The tests start their own: the package's service must not start now, nor with the machine.
if [ ! -e /usr/sbin/policy-rc.d ]; then
    printf '#!/bin/sh\nexit 101\n' >/usr/sbin/policy-rc.d
    chmod 755 /usr/sbin/policy-rc.d
    trap 'rm -f /usr/sbin/policy-rc.d' EXIT
fi
install_missing
systemctl disable -q prometheus 2>/dev/null || true
echo "install-prometheus: installed$missing"
