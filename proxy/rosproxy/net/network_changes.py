"""Notices changes of the addresses and routes of this machine.

A container may join a network at any time. Reading the networks from /proc takes a quarter of the
time of an XML-RPC call. So the kernel reports changes to the event loop (rtnetlink(7)).
"""

import asyncio
import contextlib
import socket

LOOK_INTERVAL_S = 5.0
"""Seconds after which the networks count as changed if there is no netlink socket."""
_ROUTE_FAMILY = 0  # NETLINK_ROUTE (linux/netlink.h), which Python's module lacks
_GROUPS = 0x1 | 0x10 | 0x40 | 0x100 | 0x400
"""RTMGRP_LINK, RTMGRP_IPV4_IFADDR, RTMGRP_IPV4_ROUTE, RTMGRP_IPV6_IFADDR and RTMGRP_IPV6_ROUTE
(linux/rtnetlink.h). The kernel does not report the routes that disappear with a link.
"""
_READ_BYTES = 64 * 1024


class NetworkChanges:
    """Says whether the networks may have changed. Times are seconds of a monotonic clock."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        self._last: float | None = None
        self._is_reported = False

    def noticed(self, now: float) -> bool:
        """Whether the networks may have changed since the last call that returned True.

        The first call returns True, and opens the netlink socket.
        """
        if self._last is None:
            self._subscribe()
        elif not self._is_reported and (self._socket or now - self._last < LOOK_INTERVAL_S):
            return False
        self._is_reported = False
        self._last = now
        return True

    def close(self) -> None:
        """Close the netlink socket."""
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _subscribe(self) -> None:
        self._socket = sock = _route_socket()
        if sock is not None:
            asyncio.get_running_loop().add_reader(sock, self._note, sock)

    def _note(self, sock: socket.socket) -> None:
        self._is_reported = True
        with contextlib.suppress(OSError):  # more has changed than the socket could hold (ENOBUFS)
            sock.recv(_READ_BYTES)


def _route_socket() -> socket.socket | None:
    """A socket on which the kernel reports changes; None without netlink, as in gVisor."""
    with contextlib.suppress(OSError):
        sock = socket.socket(
            socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _ROUTE_FAMILY
        )
        try:
            sock.setblocking(False)
            sock.bind((0, _GROUPS))
        except OSError:
            sock.close()
            raise
        return sock
    return None
