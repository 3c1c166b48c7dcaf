"""Ports of the range that are taken: told with who has them, where that is another proxy."""

import logging
from collections.abc import Sequence

from rosproxy.leases.leases import RANGE_OPTION
from rosproxy.net import signs
from rosproxy.settings import SettingError, Settings
from rosproxy.telemetry.problems import Problems

log = logging.getLogger(__name__)


def tell_taken(ros: str, settings: Settings, taken: Sequence[int], problems: Problems) -> None:
    """Tell of taken ports, in the log and as a problem, of the part for a version of ROS.

    Raises SettingError if no port is left: it would be a proxy that no node can use.
    """
    ports = settings.ports.listen
    if not taken:
        return
    what = "ports" if ros == "1" else "UDP ports"
    others = signs.others(ros, ports.first, ports.last, settings.admin)
    holder = "; ".join(map(str, others))
    cure = "give one of the two another range (ROSPROXY_PORT_RANGE), or end one"
    if len(taken) == len(ports):
        letter = "t" if ros == "1" else "u"
        show = f"ss -l{letter}np 'sport >= :{ports.first} and sport <= :{ports.last}'"
        who = f"held by {holder}: {cure}" if others else f"all are taken: {show} shows by whom"
        raise SettingError(RANGE_OPTION, f"no port of {ports} can be bound; {who}")
    text = f"{what} of {RANGE_OPTION} {ports} held by other programs: {list(taken)}"
    if others:
        text += f"; held by {holder}: {cure}"
    log.warning("%s", text)
    problems.add(RANGE_OPTION, text)
