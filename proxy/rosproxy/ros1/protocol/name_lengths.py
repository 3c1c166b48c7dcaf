"""How long the names and URIs are that the proxy keeps, at most.

ROS 1 bounds neither (http://wiki.ros.org/Names), and rosmaster keeps whatever comes. The proxy
keeps them as well, sends them on and shows them in its log, its metrics and ``/status``; so what
is longer than any system's is refused where it would be kept: in registrations, in calls to a node
that name a topic, and in TCPROS headers. Whatever else is that long passes as it is.
"""

from collections.abc import Iterable, Mapping

from rosproxy.ros1.protocol.master_methods import method_spec
from rosproxy.ros1.protocol.uris import LONGEST_URI
from rosproxy.ros1.protocol.xmlrpc.document import Call

LONGEST_NAME = 1024
"""Characters of a node's, topic's, service's, parameter's or type's name. Those of large systems,
nested in many namespaces, have a hundred; ROS 2 allows 255."""


def too_long_to_register(call: Call) -> str | None:
    """What in a call that registers is too long; None if nothing is, and for any other call."""
    spec = method_spec(call.method)
    if spec.registers is None:
        return None
    names = {"caller_id": 0, "name": spec.name, "type": spec.type}
    uris = {"caller_api": spec.caller_api, "service_api": spec.service_api}
    return _too_long((label, call.string(i) or "", LONGEST_NAME) for label, i in names.items()) or (
        _too_long((label, call.string(i) or "", LONGEST_URI) for label, i in uris.items())
    )


def too_long_to_ask(call: Call) -> str | None:
    """What in a call of the slave API is too long; None if nothing is."""
    names = {"caller_id": 0}
    if call.method in ("requestTopic", "publisherUpdate"):
        names["topic"] = 1
    return _too_long((label, call.string(i) or "", LONGEST_NAME) for label, i in names.items())


def too_long_to_connect(fields: Mapping[str, str]) -> str | None:
    """Which name in the fields of a TCPROS header is too long; None if none is."""
    names = ("callerid", "topic", "service")
    return _too_long((name, fields.get(name, ""), LONGEST_NAME) for name in names)


def _too_long(texts: Iterable[tuple[str, str, int]]) -> str | None:
    """The first of some texts, each with its label and bound, that is too long."""
    for label, text, most in texts:
        if len(text) > most:
            return f"{label} has {len(text)} characters, at most {most} are accepted"
    return None
