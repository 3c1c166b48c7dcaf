"""A network namespace for a proxy, in which the tests' addresses belong to other machines.

On loopback every address belongs to the proxy's machine, whose programs may always call, and a
node's claim about its address counts for less. Here the proxy is on a separate machine, with
addresses of two networks on a single cable. The other end of the cable is this machine, where all
nodes, the master and the neighbours have addresses in both networks.
"""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

# 198.18.0.0/15 is for tests of networks (RFC 2544): nothing else on this machine uses this network.
APART = "198.18.2.1"
INSIDE = "198.18.2.0/24"
"""The proxy's inside address and inside network."""
APART_HOST = "198.18.1.254"
APART_MASTER = "198.18.1.1"
"""The outside address of the proxy's machine, and the master's address."""
NODES = tuple(f"198.18.2.{number}" for number in range(11, 31))
STRANGERS = tuple(f"198.18.1.{number}" for number in range(11, 31))
"""Machines outside."""


NEAR = "abuse-near"
FAR = "abuse-far"
"""The ends of the cable: on this machine, and in the namespace."""
NAME = f"abuse-{os.getpid()}"
NAMES = Path("/etc/netns") / NAME
"""The folder whose files replace files of /etc in the namespace (ip-netns(8))."""


@contextmanager
def a_silent_name_server(hosts: Mapping[str, str]) -> Iterator[None]:
    """A proxy that starts meanwhile knows only these hosts, and waits in vain for all other
    names.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind((APART_MASTER, 53))
        NAMES.mkdir(parents=True)
        try:
            (NAMES / "resolv.conf").write_text(f"nameserver {APART_MASTER}\n")
            lines = [f"{address} {name}\n" for name, address in hosts.items()]
            (NAMES / "hosts").write_text("".join(lines))
            yield
        finally:
            shutil.rmtree(NAMES)


class Apart:
    """The namespace, which requires root."""

    def __init__(self) -> None:
        _ip("netns", "add", NAME)
        _ip("link", "add", NEAR, "type", "veth", "peer", "name", FAR, "netns", NAME)
        for address in (APART_MASTER, *STRANGERS, *NODES):
            _ip("address", "add", f"{address}/24", "dev", NEAR)
        for address in (APART, APART_HOST):
            _ip("-n", NAME, "address", "add", f"{address}/24", "dev", FAR)
        for command in (("link", "set", NEAR), ("-n", NAME, "link", "set", FAR)):
            _ip(*command, "up")
        _ip("-n", NAME, "link", "set", "lo", "up")

    @property
    def prefix(self) -> list[str]:
        """The words to put before a command to run the command in this namespace."""
        return ["ip", "netns", "exec", NAME]

    def remove(self) -> None:
        """Remove the namespace and the cable."""
        # With the namespace alone, Linux removes the cable some time later.
        _ip("link", "delete", NEAR)
        _ip("netns", "delete", NAME)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)
