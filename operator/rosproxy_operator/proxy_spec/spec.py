"""What users may ask of a proxy: each option once.

A container asks by labels, a RosProxy by the fields of its spec. The meaning of an option is that
of the proxy's own setting of the same name (`rosproxy.settings.Settings`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_type_hints

import msgspec

from rosproxy.setting_kinds import DataPlane, Direction, SlaveControl

Wishes = Mapping[str, Any]
"""What a container asks for, by the fields of `ProxySpec`."""


@dataclass(frozen=True, slots=True)
class Wish:
    """How users ask for an option.

    ``field`` is below a RosProxy's ``spec``. If the containers of a proxy ask for several values,
    the first in ``precedence`` counts. ``yields``: a container that does not ask takes any value.
    ``ros``: the only version of ROS that has the option. ``fix`` is what to write into the label.
    ``free`` are the values that no option of the administrator has to allow; empty: all values.
    """

    label: str
    field: str
    precedence: tuple[Any, ...]
    yields: bool = False
    ros: str = ""
    fix: str = ""
    free: tuple[Any, ...] = ()

    def first(self, values: Iterable[Any]) -> Any:
        """The one of several values that counts."""
        return min(values, key=self.precedence.index)


class ProxySpec(msgspec.Struct, frozen=True):
    """The options of a proxy that users may ask for."""

    data_plane: Annotated[
        DataPlane,
        Wish(
            "rosproxy.data-plane",
            "dataPlane",
            # First what the proxy can't do by itself.
            ("kernel", "splice", "copy", "auto"),
            yields=True,
            fix="kernel to let the kernel forward topics, or remove the label",
            free=("auto", "splice", "copy"),  # the kernel's takes the capability NET_ADMIN
        ),
    ] = "auto"
    direction: Annotated[
        Direction,
        Wish(
            "rosproxy.direction",
            "direction",
            # A container with a route outwards loses nothing by going through the proxy.
            ("both", "out"),
            fix="both if the nodes reach outside only through the proxy, or remove the label",
        ),
    ] = "out"
    udp: Annotated[bool, Wish("rosproxy.udp", "udp", (True, False), ros="1")] = False
    slave_control: Annotated[
        SlaveControl,
        Wish(
            "rosproxy.slave-control",
            "policy.slaveControl",
            # A node must not be open to all hosts because of a neighbour.
            ("master", "any"),
            ros="1",
            fix="master to let only the master's host call shutdown, publisherUpdate and "
            "paramUpdate, or remove the label",
        ),
    ] = "any"


OWN_SPEC = ProxySpec()
"""The proxy's own defaults."""
_HINTS = get_type_hints(ProxySpec, include_extras=True)
WISHES: Mapping[str, Wish] = {name: hint.__metadata__[0] for name, hint in _HINTS.items()}


def words(name: str) -> tuple[str, ...]:
    """The words that an option can be; none for a flag."""
    return get_args(get_args(_HINTS[name])[0])


def merged(wishes: Iterable[Wishes], defaults: ProxySpec) -> ProxySpec:
    """The options of a proxy whose containers have these wishes.

    Datagrams from outside need both directions, so ``udp`` counts only there.
    """
    every = [*wishes]
    spec: dict[str, Any] = {}
    for name, wish in WISHES.items():
        default = getattr(defaults, name)
        asked = [own.get(name, default) for own in every if name in own or not wish.yields]
        spec[name] = wish.first(asked or [default])
    return ProxySpec(**{**spec, "udp": spec["udp"] and spec["direction"] == "both"})
