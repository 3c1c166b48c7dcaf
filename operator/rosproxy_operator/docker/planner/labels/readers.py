"""What each of a container's labels says, and which master it means.

Each function that reads a label raises UnusableLabel for a value that can't be.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any
from urllib.parse import urlsplit

from rosproxy.access.rules import Rule, parse_rules
from rosproxy.net.addresses import HostPort, is_address, is_loopback
from rosproxy.ros1.protocol.uris import parse_slave_uri, slave_uri
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.docker.option_values import MOST_PORTS
from rosproxy_operator.docker.planner.labels import bounds
from rosproxy_operator.docker.planner.model import Container, HostState, Key, Network
from rosproxy_operator.docker.planner.specs import is_proxy_name, master, proxy_name
from rosproxy_operator.docker.settings import PlanSettings
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
LABELS = (
    *(ENABLE, MASTER_URI, PORTS, ADVERTISE_HOST, NETWORK),
    *(wish.label for wish in WISHES.values()),
    *(POLICY, ROS, RMW, DOMAIN, PEERS, REDIRECT),
)

ALIAS = "rosproxy"
"""The name under which every proxy is found on the networks of its containers."""
BUILT_IN = frozenset({"bridge", "host", "none"})
"""Networks that every engine has. No names resolve on them, so no proxy can be found there."""
MOST_LABEL_RULES = 100
"""Rules that a container may have."""
LONGEST_VALUE = 16 * 1024
"""Characters of a label's value: those of all rules of a container."""
LONGEST_HOST = 253
"""Characters of a host name (RFC 1035, 2.3.4)."""
_PATH = re.compile(r"[\w./~%-]*", re.ASCII)
_HOST = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_.-]{0,252}[A-Za-z0-9_.])?")

Labels = Mapping[str, str]


class UnusableLabel(Exception):
    """Why a container is left out: what is wrong, and what to do."""


class NoMaster(UnusableLabel):
    """Neither the container nor the operator names a master."""


def quoted(value: str) -> str:
    """A value as messages may show it: shortened and escaped."""
    return repr(bounded(value, 80))


def named(label: str, labels: Labels) -> str:
    """A label and its value, as messages show it."""
    return f"label {label}={quoted(labels[label])}"


def refuse_long_values(labels: Labels) -> None:
    """Raise UnusableLabel for a value that is too long to be read with each look."""
    for label in LABELS:
        if len(labels.get(label, "")) > LONGEST_VALUE:
            fix = "Join rules by globs" if label == POLICY else "Shorten the value"
            raise UnusableLabel(f"label {label} has more than {LONGEST_VALUE} characters. {fix}")


def enabled(labels: Labels, otherwise: bool) -> bool:
    """Whether a container wants a proxy; ``otherwise`` if it does not say."""
    flag = _flag(ENABLE, labels)
    return otherwise if flag is None else flag


def redirect(labels: Labels) -> bool | None:
    """Whether a master given by address may be led to the proxy, or None."""
    return _flag(REDIRECT, labels, "false")


def ports(labels: Labels) -> int:
    """How many ports the proxy is to have at least, or 0."""
    if PORTS not in labels:
        return 0
    digits = labels[PORTS].strip()
    if not re.fullmatch(r"[0-9]{1,6}", digits) or not 1 <= int(digits) <= MOST_PORTS:
        raise UnusableLabel(
            f"{named(PORTS, labels)} is not a number from 1 to {MOST_PORTS}. Give the number of "
            f"ports of the whole proxy, one for each node, such as {PORTS}=32"
        )
    return int(digits)


def wishes(
    labels: Labels, ros: str, joined: Collection[str], networks: Iterable[Network]
) -> dict[str, Any]:
    """The options that the labels ask for, for nodes of this version of ROS.

    Of the networks that it ``joined``, a container on an internal one has no route outwards.
    """
    internal = any(n.internal and n.name in joined for n in networks)
    asked = {
        name: _wish(wish, words(name), labels)
        for name, wish in WISHES.items()
        if wish.label in labels and wish.ros in ("", ros)
    }
    return {**({"direction": "both"} if internal else {}), **asked}


def policy(labels: Labels) -> tuple[Rule, ...]:
    """The rules for a container's own nodes, none without the label.

    One that can't be read leaves the container out: what its user wants to hide is not to be seen.
    """
    try:
        rules = parse_rules(labels.get(POLICY, ""))
    except ValueError as error:
        raise UnusableLabel(f"label {POLICY}: {error}") from None
    if len(rules) > MOST_LABEL_RULES:
        text = f"label {POLICY} has {len(rules)} rules, at most {MOST_LABEL_RULES} are accepted"
        raise UnusableLabel(f"{text}. Join rules by globs")
    return rules


def advertise_host(labels: Labels, settings: PlanSettings) -> str:
    """This host's name in lower case, or its address: the label's, else the option's, or empty."""
    if ADVERTISE_HOST in labels:
        return _host(named(ADVERTISE_HOST, labels), labels[ADVERTISE_HOST])
    option = settings.advertise_host
    return _host(f"the operator's --advertise-host {quoted(option)}", option) if option else ""


def networks(container: Container, observed: HostState, uplink: str) -> frozenset[str]:
    """The container's user-defined networks but the uplink, or the one that its label names."""
    net_owner = network_owner(container, observed)
    own = (net_owner.networks or _future_network(net_owner, observed)) - BUILT_IN - {uplink}
    if NETWORK in container.labels:
        return frozenset({_named_network(container.labels, own)})
    if not own:
        raise UnusableLabel(_why_no_network(net_owner))
    return own


def _flag(label: str, labels: Labels, usual: str = "true") -> bool | None:
    """Whether a label says true or false, None without it; ``usual`` is what most would want."""
    value = labels.get(label, "").strip().lower()
    if label in labels and value not in ("true", "false"):
        text = f"{named(label, labels)} is neither true nor false. Write {label}={usual}"
        raise UnusableLabel(text)
    return value == "true" if value else None


def _wish(wish: Wish, choices: Collection[str], labels: Labels) -> str | bool | None:
    """What a label says: one of the choices, else true or false."""
    value = labels[wish.label].strip().lower()
    if not choices:
        return _flag(wish.label, labels)
    if value not in choices:
        text = f"{named(wish.label, labels)} is none of {', '.join(choices)}"
        raise UnusableLabel(f"{text}. Write {wish.label}={wish.fix}")
    return value


def _host(source: str, value: str) -> str:
    bare = value.strip().removeprefix("[").removesuffix("]").lower()
    if not is_address(bare) and not _HOST.fullmatch(bare):
        raise UnusableLabel(
            f"{source} is neither a host name nor an address. Give the name or address at which "
            "outside reaches this host"
        )
    if is_loopback(bare):
        raise UnusableLabel(
            f"{source} is loopback, which no other host can reach. Give the name or address at "
            "which outside reaches this host"
        )
    return bare


def _future_network(container: Container, observed: HostState) -> frozenset[str]:
    """The network of a container that the engine is just creating, and lists without networks."""
    if container.state != "created":
        return frozenset()
    mode = container.network_mode
    return frozenset(n.name for n in observed.networks if mode in (n.name, n.id))


def _named_network(labels: Labels, own: frozenset[str]) -> str:
    """The network that the label means; compose puts its project's name in front."""
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
    """The container whose networks it has: itself, or the one that it shares them with."""
    visited = {container.id}
    while (target := container.network_container) is not None:
        sharer = next((c for c in observed.containers if target in (c.id, c.name)), None)
        if sharer is None:
            raise UnusableLabel(
                f"shares the network of container {quoted(target)}, which does not exist. Start "
                "that container, then create this container again"
            )
        if sharer.id in visited:
            raise UnusableLabel(
                f"shares the network of container {quoted(target)}, which shares the network of "
                "this container. Create one of the two with a network of its own"
            )
        visited.add(sharer.id)
        container = sharer
    return container


def _why_no_network(owner: Container) -> str:
    anew = "docker network create ros; docker run --network ros"
    if "host" in (*owner.networks, owner.network_mode):
        return (
            "is on the host's own network, where nodes need no proxy. Remove the labels, or start "
            f"the container on a user-defined network: {anew}"
        )
    if owner.network_mode == "none":  # the engine lets it join no other
        return f"is on no network. Start the container on a user-defined network: {anew}"
    live = f"docker network create ros; docker network connect ros {owner.name}"
    if "bridge" in owner.networks or owner.network_mode in ("bridge", "default"):
        where = "is only on the default bridge network, where no names resolve"
        return f"{where}. Attach the container to another network: {live}"
    return f"is on no network. Attach the container to a network: {live}"


def master_uri(container: Container, settings: PlanSettings, proxies: Collection[str]) -> str:
    """The URI of the real master: from the label, else the environment, else the settings.

    ``proxies`` are names of the operator's own containers. Raises NoMaster if there is none,
    UnusableLabel if it can't be one.
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
        f"the ROS master is not known. Add the label {MASTER_URI}=http://HOST:11311 with the real "
        "master, or start the operator with --master-uri http://HOST:11311"
    )


def proxy_alias(container: Container, key: Key) -> tuple[str, str]:
    """The name by which a container's nodes look for their proxy, and what is wrong with it.

    The name is empty if no alias can help. The second text is empty if nothing is wrong.
    """
    real = master(key)
    fix = f"Set ROS_MASTER_URI=http://{ALIAS}:{real.port}"
    if not container.master_uri:
        # Which ROS's setup script takes (ros_comm/tools/roslaunch/env-hooks/10.roslaunch.sh.in).
        nodes = "the nodes look for a master on localhost, unless a script sets the variable"
        return ALIAS, f"has no variable ROS_MASTER_URI, so {nodes}. {fix}"
    target = parse_slave_uri(container.master_uri)
    variable = f"variable ROS_MASTER_URI={quoted(container.master_uri)}"
    if target is None:
        return "", f"{variable} is not of the form http://HOST:11311. {fix}"
    host = target.host.lower()
    if not is_address(host) and host in (ALIAS, real.host, proxy_name(key)):
        if target.port == real.port:
            return host, ""
        return host, f"{variable} has the wrong port, the proxy listens on {real.port}. {fix}"
    if MASTER_URI not in container.labels:
        # A variable that names the proxy no longer says which master is meant.
        fix += f" and the label {MASTER_URI}={key.master_uri}"
    return "", f"{variable} {_wrong_master(host, key, fix)}"


def master_by_address(container: Container, key: Key) -> HostPort | None:
    """The address and port in a container's ROS_MASTER_URI that stand for its master.

    That is its master's own address, or where a label gives the master by name any address: the
    name may lead to another one by now. None for a name, and for IPv6.
    """
    target = parse_slave_uri(container.master_uri)
    real = master(key)
    if target is None or target.port != real.port or ":" in target.host:
        return None
    if not is_address(target.host) or is_loopback(target.host):
        return None
    if is_address(real.host) and target.host != real.host:
        return None
    return HostPort(target.host, target.port)


def _wrong_master(host: str, key: Key, fix: str) -> str:
    if is_proxy_name(host):
        return f"names the proxy of another master, not {proxy_name(key)}. {fix}"
    if is_loopback(host):
        return f"means the container itself. {fix}"
    if is_address(host):
        return (
            "is an address, so the nodes bypass the proxy, and outside can't reach them. "
            f"{fix}, or use the name of the master's host"
        )
    return f"is not the container's master {key.master_uri}, so the nodes bypass the proxy. {fix}"


def _names_proxy(host: str, proxies: Collection[str]) -> bool:
    return host == ALIAS or host in proxies or is_proxy_name(host)


def _allowed_master(source: str, uri: str, settings: PlanSettings, proxies: Collection[str]) -> str:
    """A master that a container names: an image may carry both the label and the variable."""
    parsed = _parse_master(source, uri, proxies)
    if refusal := bounds.refused_master(parsed, settings):
        raise UnusableLabel(f"{source} {refusal}")
    return parsed


def _parse_master(source: str, uri: str, proxies: Collection[str]) -> str:
    """A master's URI in its one form: host in lower case, no slash at the end."""
    host_port = parse_slave_uri(uri.strip())
    path = urlsplit(uri.strip()).path.rstrip("/") if host_port else ""
    is_readable = host_port and host_port.host.isascii() and len(host_port.host) <= LONGEST_HOST
    if host_port is None or not is_readable or not _PATH.fullmatch(path):
        raise UnusableLabel(f"{source} is not of the form http://HOST:11311")
    host = host_port.host.lower()
    if is_loopback(host):
        raise UnusableLabel(
            f"{source} means the container itself, where no master runs. Give the name of the "
            f"master's host, or set ROS_MASTER_URI=http://{ALIAS}:{host_port.port} and give the "
            f"master in the label {MASTER_URI}"
        )
    if _names_proxy(host, proxies):
        raise UnusableLabel(
            f"{source} names a proxy. Give the real master, such as {MASTER_URI}=http://robot:11311"
        )
    return slave_uri(HostPort(host, host_port.port), path)
