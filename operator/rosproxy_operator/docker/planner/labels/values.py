"""The values of users' labels."""

import re
from typing import get_args

from rosproxy.net.addresses import is_address, is_loopback
from rosproxy.settings import DataPlane
from rosproxy_operator.common.problem import bounded
from rosproxy_operator.docker.planner.model import MOST_PORTS

ENABLE = "rosproxy.enable"
MASTER_URI = "rosproxy.master-uri"
PORTS = "rosproxy.ports"
ADVERTISE_HOST = "rosproxy.advertise-host"
NETWORK = "rosproxy.network"
DATA_PLANE = "rosproxy.data-plane"
LABELS = (ENABLE, MASTER_URI, PORTS, ADVERTISE_HOST, NETWORK, DATA_PLANE)

_HOST = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_.-]{0,252}[A-Za-z0-9_.])?")


class UnusableLabel(Exception):
    """Why a container is left out: what is wrong, and what to do."""


def quoted(value: str) -> str:
    """A value as it may be shown: not too long, and harmless."""
    return repr(bounded(value, 80))


def boolean(label: str, value: str) -> bool:
    """``true`` or ``false``. Raises UnusableLabel."""
    word = value.strip().lower()
    if word not in ("true", "false"):
        raise UnusableLabel(
            f"label {label}={quoted(value)} is neither true nor false: write {label}=true"
        )
    return word == "true"


def count(label: str, value: str) -> int:
    """A number of ports. Raises UnusableLabel."""
    word = value.strip()
    if not re.fullmatch(r"[0-9]{1,6}", word) or not 1 <= int(word) <= MOST_PORTS:
        raise UnusableLabel(
            f"label {label}={quoted(value)} is not a number from 1 to {MOST_PORTS}: give how many "
            f"ports the whole proxy is to have, one for each node, e.g. {label}=32"
        )
    return int(word)


def data_plane(label: str, value: str) -> DataPlane:
    """One of the proxy's data planes. Raises UnusableLabel."""
    planes: tuple[DataPlane, ...] = get_args(DataPlane)
    word = value.strip().lower()
    for plane in planes:
        if word == plane:
            return plane
    raise UnusableLabel(
        f"label {label}={quoted(value)} is none of {', '.join(planes)}: write {label}=kernel for a "
        "proxy that lets the kernel forward, or leave it out"
    )


def host(source: str, value: str) -> str:
    """A host's name in lower case, or its address. Raises UnusableLabel, which names ``source``."""
    bare = value.strip().removeprefix("[").removesuffix("]").lower()
    if not is_address(bare) and not _HOST.fullmatch(bare):
        raise UnusableLabel(
            f"{source} is neither a host name nor an address: give the one under which others "
            "reach this host"
        )
    if is_loopback(bare):
        raise UnusableLabel(
            f"{source} means another host to everybody else: give the name or address under which "
            "others reach this host"
        )
    return bare
