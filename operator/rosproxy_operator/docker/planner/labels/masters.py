"""Which master a container means, and whether its nodes will find their proxy."""

import re
from collections.abc import Collection
from urllib.parse import urlsplit

from rosproxy.net.addresses import HostPort, is_address, is_loopback
from rosproxy.ros1.protocol.uris import parse_slave_uri, slave_uri
from rosproxy_operator.docker.planner.labels.values import MASTER_URI, UnusableLabel, named, quoted
from rosproxy_operator.docker.planner.model import Container, Key, PlanSettings
from rosproxy_operator.docker.planner.specs import is_proxy_name, master, proxy_name

ALIAS = "rosproxy"
"""The name under which every proxy is found on the networks of its containers."""
_PATH = re.compile(r"[\w./~%-]*", re.ASCII)


def master_uri(container: Container, settings: PlanSettings, proxies: Collection[str]) -> str:
    """The URI of the real master: from the label, else the environment, else the settings.

    ``proxies`` are names of the operator's own containers. Raises UnusableLabel if there is none
    or it can't be one.
    """
    if MASTER_URI in container.labels:
        source = named(MASTER_URI, container.labels)
        return _parse_master(source, container.labels[MASTER_URI], proxies)
    where = parse_slave_uri(container.master_uri)
    if container.master_uri and not (where and _names_proxy(where.host.lower(), proxies)):
        source = f"its variable ROS_MASTER_URI={quoted(container.master_uri)}"
        return _parse_master(source, container.master_uri, proxies)
    if settings.master_uri:
        source = f"the operator's --master-uri {quoted(settings.master_uri)}"
        return _parse_master(source, settings.master_uri, proxies)
    raise UnusableLabel(
        f"no master is known: add the label {MASTER_URI}=http://HOST:11311 with the real master, "
        "or start the operator with --master-uri"
    )


def looks_for(container: Container, key: Key) -> tuple[str, str]:
    """The name by which a container's nodes look for their proxy, and what is wrong with it.

    The name is empty if no alias can help. The second text is empty if nothing is wrong.
    """
    if not container.master_uri:
        return ALIAS, ""
    where = parse_slave_uri(container.master_uri)
    variable = f"its variable ROS_MASTER_URI={quoted(container.master_uri)}"
    right = master(key)
    fix = f"set ROS_MASTER_URI=http://{ALIAS}:{right.port}"
    if where is None:
        return "", f"{variable} is not of the form http://HOST:11311: {fix}"
    host = where.host.lower()
    if not is_address(host) and host in (ALIAS, right.host, proxy_name(key)):
        if where.port == right.port:
            return host, ""
        return host, f"{variable}: the proxy stands at its master's port {right.port}: {fix}"
    return "", f"{variable} {_wrong_master(host, key, fix)}"


def _wrong_master(host: str, key: Key, fix: str) -> str:
    if is_proxy_name(host):
        return f"names another master's proxy, its own is {proxy_name(key)}: {fix}"
    if is_loopback(host):
        return f"is the container itself: {fix}"
    if is_address(host):
        return (
            "is an address, so its nodes go around the proxy and can't be reached from outside: "
            f"{fix}, or use the name of the master's host"
        )
    return f"is not its master {key.master_uri}, so its nodes go elsewhere: {fix}"


def _names_proxy(host: str, proxies: Collection[str]) -> bool:
    return host == ALIAS or host in proxies or is_proxy_name(host)


def _parse_master(source: str, uri: str, proxies: Collection[str]) -> str:
    """A master's URI in its one form: host in lower case, no slash at the end."""
    where = parse_slave_uri(uri.strip())
    path = urlsplit(uri.strip()).path.rstrip("/") if where else ""
    if where is None or not where.host.isascii() or not _PATH.fullmatch(path):
        raise UnusableLabel(f"{source} is not of the form http://HOST:11311")
    host = where.host.lower()
    if is_loopback(host):
        raise UnusableLabel(
            f"{source} is the container itself, where no master runs: give the name of the "
            f"master's host, or set ROS_MASTER_URI=http://{ALIAS}:{where.port} and the label "
            f"{MASTER_URI}"
        )
    if _names_proxy(host, proxies):
        raise UnusableLabel(
            f"{source} names a proxy: give the real master, e.g. {MASTER_URI}=http://robot:11311"
        )
    return slave_uri(HostPort(host, where.port), path)
