"""Read the labels of a container, and find the master of the container.

Each function that reads a label raises UnusableLabel for an impossible value.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, TypeVar
from urllib.parse import urlsplit

from rosproxy.shared.addresses import HostPort, is_address, is_loopback
from rosproxy.shared.policy.rules import Rule, parse_rules
from rosproxy.shared.settings import MOST_ZENOH_LINKS
from rosproxy.shared.uris import parse_slave_uri, slave_uri
from rosproxy_operator.common.problem import (
    INVALID,
    MASTER_UNKNOWN,
    NOT_ALLOWED,
    Fault,
    bounded,
)
from rosproxy_operator.common.ros2 import MOST_PEERS
from rosproxy_operator.common.zenoh import read_link_name
from rosproxy_operator.docker.option_values import MOST_PORTS
from rosproxy_operator.docker.planner.labels import bounds
from rosproxy_operator.docker.planner.model import THIS_HOST, Container, HostState, Network
from rosproxy_operator.docker.planner.network_owner import NoOwner, by_reference, find_network_owner
from rosproxy_operator.docker.planner.specs import is_proxy_name, proxy_name
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import Place
from rosproxy_operator.proxy_spec.spec import WISHES, Wish, words

ENABLE = "rosproxy.enable"
MASTER_URI = "rosproxy.master-uri"
PORTS = "rosproxy.ports"
ADVERTISE_HOST = "rosproxy.advertise-host"
NETWORK = "rosproxy.network"
POLICY = "rosproxy.policy"
ROS = "rosproxy.ros"
DOMAIN = "rosproxy.domain"
PEERS = "rosproxy.peers"
REDIRECT = "rosproxy.redirect"
RMW = "rosproxy.rmw"
LINK = "rosproxy.zenoh-link"
LABELS = (
    *(ENABLE, MASTER_URI, PORTS, ADVERTISE_HOST, NETWORK),
    *(wish.label for wish in WISHES.values()),
    *(POLICY, ROS, RMW, DOMAIN, PEERS, REDIRECT, LINK),
)

ALIAS = "rosproxy"
"""The name that every proxy for ROS 1 wants on the networks of its containers."""
BUILT_IN_NETWORKS = frozenset({"bridge", "host", "none"})
"""Networks that every engine has. No names resolve there, so nodes can't find a proxy."""
MOST_LABEL_RULES = 100
"""Most rules of a container."""
MOST_VALUE_CHARACTERS = 16 * 1024
"""Most characters of a label's value. The rules of a container are the longest value."""
MOST_HOST_CHARACTERS = 253
"""Most characters of a host name (RFC 1035, 2.3.4)."""
_PATH = re.compile(r"[\w./~%-]*", re.ASCII)
_GIVE_HOST = "Give the name or address at which outside reaches this host"
_HOST = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_.-]{0,252}[A-Za-z0-9_.])?")

Labels = Mapping[str, str]
Peer = TypeVar("Peer")


class UnusableLabel(Exception):
    """A container gets no proxy, because of a fault."""

    reason = INVALID

    def __init__(self, text: str, fix: str = "") -> None:
        self.fault = Fault(text, fix)
        super().__init__(str(self.fault))


class NoMaster(UnusableLabel):
    """Neither the container nor the operator names a master."""

    reason = MASTER_UNKNOWN


class MasterNotAllowed(UnusableLabel):
    """The administrator does not allow the master of a container."""

    reason = NOT_ALLOWED


def quoted(value: str) -> str:
    """Return a value for messages, shortened and escaped."""
    return repr(bounded(value, 80))


def named(label: str, labels: Labels) -> str:
    """Return a label and its value for messages."""
    return f"label {label}={quoted(labels[label])}"


def refuse_long_values(labels: Labels) -> None:
    """Raise UnusableLabel for a long value: the operator reads all values at each look."""
    for label in LABELS:
        if len(labels.get(label, "")) > MOST_VALUE_CHARACTERS:
            fix = "Join rules by globs" if label == POLICY else "Shorten the value"
            text = f"label {label} has more than {MOST_VALUE_CHARACTERS} characters"
            raise UnusableLabel(text, fix)


def enabled(labels: Labels) -> bool | None:
    """Return whether a container wants a proxy; None without the label."""
    return _flag(ENABLE, labels)


def redirect(labels: Labels) -> bool | None:
    """Return whether a redirect of the master's address is allowed; None without the label."""
    return _flag(REDIRECT, labels, "false")


def ports(labels: Labels) -> int:
    """Return the least number of ports of the proxy; 0 without the label."""
    if PORTS not in labels:
        return 0
    digits = labels[PORTS].strip()
    if not re.fullmatch(r"[0-9]{1,6}", digits) or not 1 <= int(digits) <= MOST_PORTS:
        raise UnusableLabel(
            f"{named(PORTS, labels)} is not a number from 1 to {MOST_PORTS}",
            f"Give the number of ports of the whole proxy, one for each node, such as {PORTS}=32",
        )
    return int(digits)


def wishes(
    labels: Labels, ros: str, joined: Collection[str], networks: Iterable[Network]
) -> dict[str, Any]:
    """Return the options that the labels ask for, for nodes of ROS version ``ros``.

    If one of the ``joined`` networks is internal, the container may have no route outwards. So the
    direction is ``both`` unless the label sets the direction. rmw_zenoh has no direction.
    """
    has_direction = ros in WISHES["direction"].ros
    internal = has_direction and any(n.internal and n.name in joined for n in networks)
    asked = {
        name: _wish(wish, words(name), labels)
        for name, wish in WISHES.items()
        if wish.label in labels and ros in wish.ros
    }
    return {**({"direction": "both"} if internal else {}), **asked}


def peers(labels: Labels, read: Callable[[str], Peer]) -> list[Peer]:
    """Return the hosts outside in the label, parsed by ``read``; empty without the label."""
    return _hosts(PEERS, labels, MOST_PEERS, read)


def links(labels: Labels) -> list[str]:
    """Return the links to other sites in the label; empty without the label."""
    return _hosts(LINK, labels, MOST_ZENOH_LINKS, read_link_name)


def _hosts(label: str, labels: Labels, most: int, read: Callable[[str], Peer]) -> list[Peer]:
    names = [name for name in re.split(r"[,\s]+", labels.get(label, "")) if name]
    if len(names) > most:
        raise UnusableLabel(f"label {label} names more than {most} hosts", "Name fewer hosts")
    try:
        return [*map(read, names)]
    except ValueError as error:
        raise UnusableLabel(f"label {label}: {error}") from None


def policy(labels: Labels) -> tuple[Rule, ...]:
    """Return the rules for the nodes of a container; empty without the label.

    A container with an unreadable rule gets no proxy: names that the user wants to hide must not
    become visible.
    """
    try:
        rules = parse_rules(labels.get(POLICY, ""))
    except ValueError as error:
        raise UnusableLabel(f"label {POLICY}: {error}") from None
    if len(rules) > MOST_LABEL_RULES:
        text = f"label {POLICY} has {len(rules)} rules, at most {MOST_LABEL_RULES} are accepted"
        raise UnusableLabel(text, "Join rules by globs")
    return rules


def advertise_host(labels: Labels, settings: PlanSettings) -> str:
    """Return the advertised host in lower case, from the label, else the option, else empty."""
    if ADVERTISE_HOST in labels:
        return _host(named(ADVERTISE_HOST, labels), labels[ADVERTISE_HOST])
    option = settings.advertise_host
    return _host(f"the operator's --advertise-host {quoted(option)}", option) if option else ""


def networks(container: Container, observed: HostState, uplink: str) -> frozenset[str]:
    """Return the network in the label, else all user-defined networks except the uplink.

    A container in the network namespace of another container has the networks of that container.
    """
    net_owner = network_owner(container, observed)
    own = (
        (net_owner.networks or _future_network(net_owner, observed)) - BUILT_IN_NETWORKS - {uplink}
    )
    if NETWORK in container.labels:
        return frozenset({_named_network(container.labels, own)})
    if not own:
        raise UnusableLabel(*_why_no_network(net_owner))
    return own


def _flag(label: str, labels: Labels, usual: str = "true") -> bool | None:
    """Return whether a label says true; None without the label. The error proposes ``usual``."""
    value = labels.get(label, "").strip().lower()
    if label in labels and value not in ("true", "false"):
        text = f"{named(label, labels)} is neither true nor false"
        raise UnusableLabel(text, f"Write {label}={usual}")
    return value == "true" if value else None


def _wish(wish: Wish, choices: Collection[str], labels: Labels) -> str | bool | None:
    """Return the value of a label: one of the choices, or true or false if there are none."""
    value = labels[wish.label].strip().lower()
    if not choices:
        return _flag(wish.label, labels)
    if value not in choices:
        text = f"{named(wish.label, labels)} is none of {', '.join(choices)}"
        raise UnusableLabel(text, f"Write {wish.label}={wish.fix}")
    return value


def _host(source: str, value: str) -> str:
    bare = value.strip().removeprefix("[").removesuffix("]").lower()
    if not is_address(bare) and not _HOST.fullmatch(bare):
        raise UnusableLabel(f"{source} is neither a host name nor an address", _GIVE_HOST)
    if is_loopback(bare):
        raise UnusableLabel(f"{source} is loopback, which no other host can reach", _GIVE_HOST)
    return bare


def _future_network(container: Container, observed: HostState) -> frozenset[str]:
    """Return the network of a container in the state created; empty in all other states.

    The engine lists such a container without networks for a moment.
    """
    if container.state != "created":
        return frozenset()
    mode = container.network_mode
    return frozenset(n.name for n in observed.networks if mode in (n.name, n.id))


def _named_network(labels: Labels, own: frozenset[str]) -> str:
    """Return the network that the label means, also without Compose's prefix ``PROJECT_``."""
    label = labels[NETWORK]
    for name in (label, f"{labels.get('com.docker.compose.project')}_{label}"):
        if name in own:
            return name
    names = ", ".join(sorted(own)) or "none that is user-defined"
    raise UnusableLabel(
        f"{named(NETWORK, labels)} is no network of the container. The container's networks: "
        f"{names}"
    )


def network_owner(container: Container, observed: HostState) -> Container:
    """Return the container that owns the network namespace of ``container``.

    Raises UnusableLabel if that container does not exist, and for a loop of containers.
    """
    if container.network_container is None:
        return container
    try:
        return find_network_owner(container, by_reference(observed.containers))
    except NoOwner as error:
        shared = f"shares the network of container {quoted(error.target)}, which"
        if error.is_loop:
            raise UnusableLabel(
                f"{shared} shares the network of this container",
                "Create one of the two with a network of its own",
            ) from None
        raise UnusableLabel(
            f"{shared} does not exist", "Start that container, then create this container again"
        ) from None


def _why_no_network(owner: Container) -> Fault:
    anew = "docker network create ros; docker run --network ros"
    if "host" in (*owner.networks, owner.network_mode):
        return Fault(
            "is on the host's own network, where nodes need no proxy",
            f"Remove the labels, or start the container on a user-defined network: {anew}",
        )
    # The engine connects no container of the mode none to another network.
    if owner.network_mode == "none":
        return Fault("is on no network", f"Start the container on a user-defined network: {anew}")
    live = f"docker network create ros; docker network connect ros {owner.name}"
    if "bridge" in owner.networks or owner.network_mode in ("bridge", "default"):
        # Nodes of ROS 2 use only the networks that they had at their start.
        return Fault(
            "is only on the default bridge network, which the proxy does not join",
            f"Attach the container to another network: {live}; docker restart {owner.name}; docker "
            f"network disconnect bridge {owner.name}. With Compose, remove network_mode",
        )
    return Fault("is on no network", f"Attach the container to a network: {live}")


def master_uri(container: Container, settings: PlanSettings, proxies: Collection[str]) -> str:
    """Return the URI of the real master: from the label, else the variable, else --master-uri.

    A variable that names a proxy does not count. ``proxies`` are the names of the operator's own
    containers. Raises NoMaster without a URI, and UnusableLabel for an impossible URI.
    """
    if MASTER_URI in container.labels:
        source = named(MASTER_URI, container.labels)
        return _allowed_master(source, container.labels[MASTER_URI], settings, proxies)
    host_port = parse_slave_uri(container.master_uri)
    if container.master_uri and not (host_port and _names_proxy(host_port.host.lower(), proxies)):
        source = f"variable ROS_MASTER_URI={quoted(container.master_uri)}"
        return _allowed_master(source, container.master_uri, settings, proxies)
    if settings.master_uri:
        source = f"the operator's --master-uri {quoted(settings.master_uri)}"
        return _parse_master(source, settings.master_uri, proxies)
    raise NoMaster(
        "the ROS master is not known",
        f"Add the label {MASTER_URI}=http://HOST:11311 with the real master, or start the operator "
        "with --master-uri http://HOST:11311",
    )


def proxy_alias(container: Container, place: Place) -> tuple[str, Fault | None]:
    """Return the name by which a container's nodes look for the proxy, and a warning.

    The name is empty if no alias can help. The warning is None if nothing is wrong.
    """
    real = place.master
    fix = f"Set ROS_MASTER_URI=http://{ALIAS}:{real.port}"
    if not container.master_uri:
        # Without the variable, ROS's setup script sets ROS_MASTER_URI to localhost
        # (ros_comm/tools/roslaunch/env-hooks/10.roslaunch.sh.in).
        nodes = "the nodes look for a master on localhost, unless a script sets the variable"
        return ALIAS, Fault(f"has no variable ROS_MASTER_URI, so {nodes}", fix)
    target = parse_slave_uri(container.master_uri)
    variable = f"variable ROS_MASTER_URI={quoted(container.master_uri)}"
    if target is None:
        return "", Fault(f"{variable} is not of the form http://HOST:11311", fix)
    host = target.host.lower()
    # A variable that names the proxy does not say which master the container means.
    label = "" if MASTER_URI in container.labels else f" and the label {MASTER_URI}={real.uri}"
    if container.master_entry:
        text = f"{variable} leads past the proxy: /etc/hosts of the container has {host}"
        fix += label
        if host != THIS_HOST:  # no proxy gets this name, so the entry has to stay
            remove = f"Remove {host} from extra_hosts of the service (docker run: --add-host)"
            fix = f"{remove}. Or {fix[0].lower()}{fix[1:]}"
        return "", Fault(text, fix)
    if not is_address(host) and host in (ALIAS, real.host, proxy_name(place)):
        if target.port == real.port:
            return host, None
        text = f"{variable} has the wrong port, the proxy listens on {real.port}"
        return host, Fault(text, fix)
    return "", _wrong_master(host, place, variable, f"{fix}{label}")


def master_by_address(container: Container, place: Place) -> HostPort | None:
    """Return the address in a container's ROS_MASTER_URI that a redirect may lead to the proxy.

    The container may have the address in /etc/hosts. If a label gives the master by name, any
    address is accepted: the name may resolve to another address by now. Otherwise the address has
    to be the master's. None for a wrong port, a name, loopback and IPv6.
    """
    target = parse_slave_uri(container.master_uri)
    real = place.master
    if target is None or target.port != real.port:
        return None
    host = container.master_entry or target.host
    if not is_address(host) or is_loopback(host) or ":" in host:
        return None
    if is_address(real.host) and host != real.host:
        return None
    return HostPort(host, target.port)


def _wrong_master(host: str, place: Place, variable: str, fix: str) -> Fault:
    if is_proxy_name(host):
        text = f"names the proxy of another master, not {proxy_name(place)}"
    elif is_loopback(host):
        text = "means the container itself"
    elif is_address(host):
        text = "is an address, so the nodes bypass the proxy, and outside can't reach them"
        fix += ", or use the name of the master's host"
    else:
        text = f"is not the container's {place.graph}, so the nodes bypass the proxy"
    return Fault(f"{variable} {text}", fix)


def _names_proxy(host: str, proxies: Collection[str]) -> bool:
    return host == ALIAS or host in proxies or is_proxy_name(host)


def _allowed_master(source: str, uri: str, settings: PlanSettings, proxies: Collection[str]) -> str:
    """Return the URI of a master that a container names, if the administrator allows that master.

    An image may carry the label or the variable, so the operator checks both.
    """
    parsed = _parse_master(source, uri, proxies)
    if refusal := bounds.refused_master(parsed, settings):
        raise MasterNotAllowed(f"{source} {refusal.text}", refusal.fix)
    return parsed


def _parse_master(source: str, uri: str, proxies: Collection[str]) -> str:
    """Return the canonical URI of a master: the host in lower case, no slash at the end."""
    host_port = parse_slave_uri(uri.strip())
    path = urlsplit(uri.strip()).path.rstrip("/") if host_port else ""
    is_readable = (
        host_port and host_port.host.isascii() and len(host_port.host) <= MOST_HOST_CHARACTERS
    )
    if host_port is None or not is_readable or not _PATH.fullmatch(path):
        raise UnusableLabel(f"{source} is not of the form http://HOST:11311")
    host = host_port.host.lower()
    if is_loopback(host):
        raise UnusableLabel(
            f"{source} means the container itself, and a proxy reaches no master there",
            f"Give the master in the label {MASTER_URI}, and set ROS_MASTER_URI=http://{ALIAS}:"
            f"{host_port.port}. A master on this host is http://{THIS_HOST}:{host_port.port}. If "
            "the master runs in this container, move roscore to a container of its own",
        )
    if _names_proxy(host, proxies):
        raise UnusableLabel(
            f"{source} names a proxy",
            f"Give the real master, such as {MASTER_URI}=http://robot:11311",
        )
    return slave_uri(HostPort(host, host_port.port), path)
