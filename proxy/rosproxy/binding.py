"""Errors for ports and addresses that can't be bound, with the option and the likely holder."""

import contextlib
import errno
import logging
from collections.abc import Collection, Iterator, Sequence

from rosproxy.net import proxy_signs
from rosproxy.shared.output.problems import Problems
from rosproxy.shared.setting_kinds import SettingError
from rosproxy.shared.settings import Settings

log = logging.getLogger(__name__)

RANGE_OPTION = "--port-range"
PORTS = "ports"
"""The subject of problems with the range."""


@contextlib.contextmanager
def setting_error_if_taken(
    option: str, subject: object, holders: Collection[object] = ()
) -> Iterator[None]:
    """A context in which the caller binds ``subject``. Raises SettingError in place of OSError.

    ``holders``: the programs that probably hold ``subject``, for the message.
    """
    try:
        yield
    except OSError as error:
        text = f"{subject} can't be bound: {error.strerror}"
        if error.errno == errno.EADDRINUSE:
            text += f" by {'; '.join(map(str, holders))}" if holders else " (see ss -ltunp)"
        raise SettingError(option, text) from None


def report_taken_ports(
    ros: str, settings: Settings, taken: Sequence[int], problems: Problems
) -> None:
    """Report the ports that other programs hold, in the log and as a problem.

    ``ros`` 1 stands for TCP ports, any other for UDP ports. Does nothing if ``taken`` is empty.
    Raises SettingError if all ports of the range are taken: no node could use the proxy.
    """
    ports = settings.ports.listen
    if not taken:
        return
    port_kind = "ports" if ros == "1" else "UDP ports"
    proxies = proxy_signs.overlapping_proxies(ros, ports.first, ports.last)
    holders = "; ".join(map(str, proxies))
    fix = "give one of the two another range (ROSPROXY_PORT_RANGE), or end one"
    if len(taken) == len(ports):
        letter = "t" if ros == "1" else "u"
        show = f"ss -l{letter}np 'sport >= :{ports.first} and sport <= :{ports.last}'"
        cause = f"held by {holders}: {fix}" if proxies else f"other programs hold all: run {show}"
        raise SettingError(RANGE_OPTION, f"no port of {ports} can be bound; {cause}")
    text = f"{port_kind} of the range {ports} held by other programs: {list(taken)}"
    if proxies:
        text += f"; held by {holders}: {fix}"
    log.warning("%s", text)
    problems.add(PORTS, text, holds=True)
