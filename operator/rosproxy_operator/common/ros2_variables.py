"""The variables of ROS 2 and DDS in a container that show the version or prevent discovery.

A DDS profile may contain anything, and the operator does not read files in containers. So the
operator reports these variables only if the proxy discovers no participant of the container.
"""

from collections.abc import Callable, Mapping

from rosproxy.shared.output.text import brief
from rosproxy_operator.common.problem import Fault

MOST_VALUE_CHARACTERS = 80
"""The most characters of a variable's value in a report."""

_PROFILE = Fault(
    "The DDS profile may name other interfaces, other addresses or a discovery server",
    "Unset the variable, or change the profile: UDP on all interfaces, no announced address",
)
_LOCAL = "The nodes discover only nodes on their own machine"


def _always(_: str) -> bool:
    return True


def _has_unsupported_transports(value: str) -> bool:
    """Whether FASTDDS_BUILTIN_TRANSPORTS names transports that a proxy can't forward.

    LARGE_DATA sends data by TCP, after discovery by UDP (Fast DDS, rtps/builtin_transports).
    """
    return value.upper().partition("?")[0] not in ("", "DEFAULT", "DEFAULTV6", "UDPV4", "UDPV6")


_DISCOVERY_OBSTACLES: dict[str, tuple[Callable[[str], bool], Fault]] = {
    "ROS_DISCOVERY_SERVER": (
        _always,
        Fault("The nodes announce themselves only to a discovery server", "Unset the variable"),
    ),
    "ROS_LOCALHOST_ONLY": (lambda value: value == "1", Fault(_LOCAL, "Unset the variable")),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": (
        lambda value: value.upper() in ("LOCALHOST", "OFF"),
        Fault(_LOCAL, "Unset the variable, or set SUBNET"),
    ),
    "FASTDDS_BUILTIN_TRANSPORTS": (
        _has_unsupported_transports,
        Fault("A proxy forwards UDP only", "Unset the variable, or set UDPv4"),
    ),
    "CYCLONEDDS_URI": (_always, _PROFILE),
    "FASTDDS_DEFAULT_PROFILES_FILE": (_always, _PROFILE),
    "FASTRTPS_DEFAULT_PROFILES_FILE": (_always, _PROFILE),
}
"""Variables that may prevent discovery, the surest cause first.

Each variable has a test, which is true for values that prevent discovery, and the cause with the
fix.
"""

ROS2_VARIABLES = frozenset(
    {*_DISCOVERY_OBSTACLES, "ROS_DOMAIN_ID", "ROS_STATIC_PEERS", "RMW_IMPLEMENTATION"}
)
"""Variables that ROS 1 does not have."""


def discovery_obstacle(variables: Mapping[str, str]) -> Fault | None:
    """Return which variable may prevent discovery, and the fix; None without such a variable.

    Of several, the text has the surest with its cause, and the names of the others.
    """
    found = [
        name
        for name, (prevents_discovery, _) in _DISCOVERY_OBSTACLES.items()
        if (value := variables.get(name, ""))
        and prevents_discovery(value)
        and not name.startswith(_of_another_rmw(variables))
    ]
    if not found:
        return None
    first, *others = found
    cause = _DISCOVERY_OBSTACLES[first][1]
    more = f". Or the cause is {' or '.join(others)}" if others else ""
    shown = f"variable {first}={brief(variables[first], MOST_VALUE_CHARACTERS)}"
    return Fault(f"{shown}. {cause.text}{more}", cause.fix)


def _of_another_rmw(variables: Mapping[str, str]) -> tuple[str, ...]:
    """The beginnings of variables that the RMW of a container does not read."""
    rmw = variables.get("RMW_IMPLEMENTATION", "")
    if "fastrtps" in rmw:
        return ("CYCLONEDDS_",)
    return ("FASTDDS_", "FASTRTPS_", "ROS_DISCOVERY_SERVER") if "cyclonedds" in rmw else ()
