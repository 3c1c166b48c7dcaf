"""Bounds for the length of names and URIs that the proxy stores.

ROS 1 has no such bounds (http://wiki.ros.org/Names), and rosmaster stores names of any length. The
proxy stores names as well, sends them on, and shows them in its log, its metrics and ``/status``.
So the proxy refuses names that are longer than in any real system: in registrations, in calls of
the slave API, and in TCPROS headers. All other long texts pass unchanged.
"""

from collections.abc import Iterable, Mapping

from rosproxy.ros1.protocol.master_methods import method_spec
from rosproxy.ros1.protocol.xmlrpc.document import Call
from rosproxy.shared.uris import LONGEST_URI

LONGEST_NAME = 1024
"""Characters of the name of a node, topic, service, parameter or type. Names of large systems with
many nested namespaces have a hundred; ROS 2 allows 255."""


def too_long_to_register(call: Call) -> str | None:
    """What is too long in a call that registers; None if nothing is, and for any other call."""
    spec = method_spec(call.method)
    if spec.registers is None:
        return None
    names = {"caller_id": 0, "name": spec.name, "type": spec.type}
    uris = {"caller_api": spec.caller_api, "service_api": spec.service_api}
    return _too_long((label, call.string(i) or "", LONGEST_NAME) for label, i in names.items()) or (
        _too_long((label, call.string(i) or "", LONGEST_URI) for label, i in uris.items())
    )


def too_long_to_ask(call: Call) -> str | None:
    """What is too long in a call of the slave API; None if nothing is."""
    names = {"caller_id": 0}
    if call.method in ("requestTopic", "publisherUpdate"):
        names["topic"] = 1
    return _too_long((label, call.string(i) or "", LONGEST_NAME) for label, i in names.items())


def too_long_to_connect(fields: Mapping[str, str]) -> str | None:
    """Which name is too long in the fields of a TCPROS header; None if none is."""
    names = ("callerid", "topic", "service")
    return _too_long((name, fields.get(name, ""), LONGEST_NAME) for name in names)


def _too_long(texts: Iterable[tuple[str, str, int]]) -> str | None:
    """Describe the first text over the bound, from (label, text, bound); None if all texts fit."""
    for label, text, most in texts:
        if len(text) > most:
            return f"{label} has {len(text)} characters, at most {most} are accepted"
    return None
