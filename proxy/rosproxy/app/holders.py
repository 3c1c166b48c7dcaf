"""Reports the ports of the range that are taken, with who has them if that is another proxy."""

import logging
from collections.abc import Sequence

from rosproxy.leases.leases import RANGE_OPTION
from rosproxy.net import signs
from rosproxy.settings import SettingError, Settings
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)


def report_taken_ports(
    ros: str, settings: Settings, taken: Sequence[int], problems: Problems
) -> None:
    """Report taken ports in the log and as a problem, for one version of ROS.

    Raises SettingError if no port is left: it would be a proxy that no node can use.
    """
    ports = settings.ports.listen
    if not taken:
        return
    port_kind = "ports" if ros == "1" else "UDP ports"
    proxies = signs.overlapping_proxies(ros, ports.first, ports.last, settings.admin)
    holders = "; ".join(map(str, proxies))
    cure = "give one of the two another range (ROSPROXY_PORT_RANGE), or end one"
    if len(taken) == len(ports):
        letter = "t" if ros == "1" else "u"
        show = f"ss -l{letter}np 'sport >= :{ports.first} and sport <= :{ports.last}'"
        cause = f"held by {holders}: {cure}" if proxies else f"all are taken: {show} shows by whom"
        raise SettingError(RANGE_OPTION, f"no port of {ports} can be bound; {cause}")
    text = f"{port_kind} of {RANGE_OPTION} {ports} held by other programs: {list(taken)}"
    if proxies:
        text += f"; held by {holders}: {cure}"
    log.warning("%s", text)
    problems.add(RANGE_OPTION, text)
