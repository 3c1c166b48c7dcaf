#!/bin/sh
# Installs Prometheus and promtool for the tests of dashboard and alerts, on Debian or Ubuntu, as
# root. Does nothing if both are installed.
set -eu
. "$(dirname "$0")/debian.sh"

need install-prometheus prometheus
# The tests start Prometheus. The package's service must not start, now or with the machine.
if [ ! -e /usr/sbin/policy-rc.d ]; then
    printf '#!/bin/sh\nexit 101\n' >/usr/sbin/policy-rc.d
    chmod 755 /usr/sbin/policy-rc.d
    trap 'rm -f /usr/sbin/policy-rc.d' EXIT
fi
install_missing
systemctl disable -q prometheus 2>/dev/null || true
echo "install-prometheus: installed$missing"
