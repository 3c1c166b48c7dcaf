"""The options of a proxy that users may set, for all engines.

A container sets an option by a label, a RosProxy by a field of the spec. An option means the same
as the proxy's setting of this name (`rosproxy.shared.settings.Settings`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_type_hints

import msgspec

from rosproxy.shared.setting_kinds import DataPlane, Direction, LogLevel, SlaveControl

Wishes = Mapping[str, Any]
"""The values that a container asks for, by the fields of `ProxySpec`."""


@dataclass(frozen=True, slots=True)
class Wish:
    """The label and the field of an option, and the rules for the value.

    - ``field``: the field below a RosProxy's ``spec``.
    - ``precedence``: of several values that the containers ask for, the first one here counts.
    - ``yields``: a container without the label accepts any value. If False, such a container asks
      for the default.
    - ``ros``: the versions of ROS with this option, in the words of the proxy's ``--ros``.
    - ``fix``: the text after ``label=`` in a fix.
    - ``free``: the values that need no permission of the administrator; empty: no value needs it.
    """

    label: str
    field: str
    precedence: tuple[Any, ...]
    yields: bool = False
    ros: tuple[str, ...] = ("1", "2")
    fix: str = ""
    free: tuple[Any, ...] = ()

    def first(self, values: Iterable[Any]) -> Any:
        """The value that counts, by `precedence`."""
        return min(values, key=self.precedence.index)


class ProxySpec(msgspec.Struct, frozen=True):
    """The options of a proxy that users may ask for."""

    data_plane: Annotated[
        DataPlane,
        Wish(
            "rosproxy.data-plane",
            "dataPlane",
            # kernel first: only this value needs a capability from the operator.
            ("kernel", "splice", "copy", "auto"),
            yields=True,
            fix="kernel to let the kernel forward topics, or remove the label",
            free=("auto", "splice", "copy"),  # kernel needs the capability NET_ADMIN
        ),
    ] = "auto"
    direction: Annotated[
        Direction,
        Wish(
            "rosproxy.direction",
            "direction",
            # both first: a container that has its own route outwards also works through the proxy.
            ("both", "out"),
            fix="both if the nodes reach outside only through the proxy, or remove the label",
        ),
    ] = "out"
    udp: Annotated[bool, Wish("rosproxy.udp", "udp", (True, False), ros=("1",))] = False
    slave_control: Annotated[
        SlaveControl,
        Wish(
            "rosproxy.slave-control",
            "policy.slaveControl",
            # The label of another container must not open a node to all hosts.
            ("master", "any"),
            ros=("1",),
            fix="master to let only the master's host call shutdown, publisherUpdate and "
            "paramUpdate, or remove the label",
        ),
    ] = "any"
    log_level: Annotated[
        LogLevel,
        Wish(
            "rosproxy.log-level",
            "logLevel",
            # debug first: a user that looks for a fault needs all messages. A container without
            # the label asks for info: the label of another container hides none of its warnings.
            ("debug", "info", "warning", "error"),
            ros=("1", "2", "zenoh"),
            fix="debug to see all messages of the proxy, or remove the label",
        ),
    ] = "info"


OWN_SPEC = ProxySpec()
"""The proxy's own defaults."""
_HINTS = get_type_hints(ProxySpec, include_extras=True)
WISHES: Mapping[str, Wish] = {name: hint.__metadata__[0] for name, hint in _HINTS.items()}
"""The options, by the fields of `ProxySpec`."""


def words(name: str) -> tuple[str, ...]:
    """The words that a user may give as the value of an option; empty for a flag."""
    return get_args(get_args(_HINTS[name])[0])


def options(spec: ProxySpec, ros: str) -> dict[str, Any]:
    """The options of a proxy that serves only ROS version ``ros``, by the fields of `ProxySpec`."""
    return {name: getattr(spec, name) for name, wish in WISHES.items() if ros in wish.ros}


def merged(wishes: Iterable[Wishes], defaults: ProxySpec) -> ProxySpec:
    """The options of a proxy for the wishes of its containers.

    ``defaults`` has the value of each option for which no container asks. ``udp`` counts only with
    direction both: UDPROS from outside needs both directions.
    """
    every = [*wishes]
    spec: dict[str, Any] = {}
    for name, wish in WISHES.items():
        default = getattr(defaults, name)
        asked = [own.get(name, default) for own in every if name in own or not wish.yields]
        spec[name] = wish.first(asked or [default])
    return ProxySpec(**{**spec, "udp": spec["udp"] and spec["direction"] == "both"})
