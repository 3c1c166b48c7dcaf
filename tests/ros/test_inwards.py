"""Inside nodes have no way out but the proxy, which has no ports for datagrams.

So rules about outside names are enforced. Elsewhere rules only hide, and a node that knows an
address connects by itself. For subscribers with UDP alone, the doctor reports the missing option.
"""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from urllib.parse import urlsplit

import pytest

from rosproxy.ros1.protocol.tcpros import decode_header, encode_header
from tests.ros import wire
from tests.ros.combinations import LIBRARIES
from tests.ros.lab import CALLER, Lab
from tests.ros.topology import SHARED

pytestmark = pytest.mark.boundary

PLAN = replace(SHARED, name="p", isolated=True)


def told(lab: Lab, method: str, name: str, role: str = "c1") -> tuple[str, int]:
    """The address of a node or service that a machine gets from the master."""
    parts = urlsplit(lab.ask_master(method, name, role=role))
    assert parts.hostname
    assert parts.port
    return parts.hostname, parts.port


def greet(lab: Lab, address: tuple[str, int], **fields: str) -> dict[str, str]:
    """The answer to a TCPROS header from inside."""
    header = {"callerid": "/spy", "md5sum": "*", "type": "*", **fields}
    with lab.place("c1").entered(), socket.create_connection(address, timeout=20) as conn:
        conn.sendall(encode_header(header))
        stream = conn.makefile("rb")
        return decode_header(stream.read(int.from_bytes(stream.read(4), "little")))


@pytest.mark.parametrize(
    ("outside_library", "inside_library"), [LIBRARIES, LIBRARIES[::-1]], ids=LIBRARIES
)
def test_what_is_denied_is_not_reached_by_a_known_address_either(
    lab: Lab, outside_library: str, inside_library: str
) -> None:
    topic = f"/{lab.unique('t')}"
    service = f"/{lab.unique('s')}"
    name = lab.unique("talker")
    lab.node(outside_library, "out", "pub", name=name, topic=topic, rate=20)
    lab.node(outside_library, "out", "serve", service=service).wait_for("^ready")
    receiver = lab.node(inside_library, "c1", "sub", topic=topic)
    receiver.wait_for_count("^got ", 5)
    lab.node(inside_library, "c2", "call", service=service, count=3).wait_for("^done")
    talker = told(lab, "lookupNode", f"/{name}")
    server = told(lab, "lookupService", service)
    assert "error" not in greet(lab, talker, topic=topic)
    assert "error" not in greet(lab, server, service=service)

    rules = [f"deny subscribe {topic}", f"deny call {service}"]
    layer = {"name": "test", "mode": "enforce", "rules": rules, "addresses": None}
    assert lab.tell("/policy", layers=[layer])["cut"] > 0

    assert "deny subscribe" in greet(lab, talker, topic=topic)["error"]
    assert "deny call" in greet(lab, server, service=service)["error"]
    with pytest.raises(LookupError, match="deny subscribe"):
        wire.call(lab.place("c1"), *talker, "requestTopic", CALLER, topic, [["TCPROS"]])
    for itself in (told(lab, "lookupNode", f"/{name}", "out"),
                   told(lab, "lookupService", service, "out")):  # fmt: skip
        address = (lab.place("out").address, itself[1])
        with lab.place("c1").entered(), pytest.raises(OSError, match="unreachable"):
            socket.create_connection(address, timeout=20)
    lab.tell("/policy", layers=[])
    receiver.wait_for_count("^got ", 5, since=receiver.mark())


def test_who_wants_datagrams_alone_is_told_what_that_needs(lab: Lab) -> None:
    topic = f"/{lab.unique('topic')}"
    lab.node("roscpp", "out", "pub", topic=topic)
    deaf = lab.node("roscpp", "c1", "sub", topic=topic, udp=1)
    deaf.wait_for("^ready")
    report = " ".join(lab.rosproxy("doctor", topic, check=False).output.split())
    assert "If the subscriber accepts UDPROS only, set --udp" in report, report
    assert "got " not in deaf.output()


@pytest.mark.parametrize("library", LIBRARIES)
def test_the_live_page_shows_what_comes_in_by_the_proxy(lab: Lab, library: str) -> None:
    topic = f"/{lab.unique('topic')}"
    name = lab.unique("talker")
    lab.node(library, "out", "pub", name=name, topic=topic, rate=20)
    lab.node(library, "c1", "sub", topic=topic).wait_for_count("^got ", 5)
    shown = lab.wait_shown(topic, carried="splice", state="ok", flows=True)
    status = json.loads(lab.rosproxy("status", "--json").output)
    ports = {stand_in["uri"]: stand_in["port"] for stand_in in status["stand_ins"]}
    assert shown["port"] == ports[lab.node_uri(name)]
