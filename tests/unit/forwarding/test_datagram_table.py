"""nftables for datagrams: documents for nft, and the output of nft."""

import json
import re
from typing import Any

import pytest

from rosproxy.forwarding.kernel.datagram_table import DatagramTable
from rosproxy.forwarding.kernel.decisions import Changes
from rosproxy.forwarding.kernel.nft import Counts, NftError, Surroundings, TableState
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange

TABLE = DatagramTable(PortRange(45000, 45999))
FOUR = HostPort("10.0.0.5", 7411)
SIX = HostPort("fd00::5", 7413)
FORWARDS = {45001: FOUR, 45002: SIX}
AROUND = Surroundings(sources={"10.0.0.5": "10.0.0.2", "fd00::5": "fd00::2"})


def elements(document: str, verb: str = "add") -> dict[str, str]:
    """The elements that a document adds or deletes, by map and set."""
    found = re.findall(
        rf"^{verb} element inet rosproxy-udp-45000 (\w+) {{ (.*) }}$", document, re.M
    )
    return dict(found)


def rules(chain: str) -> list[str]:
    """The rules of a chain."""
    body = re.search(rf"chain {chain} {{\n(.*?)\n  }}", TABLE.made({}, AROUND), re.S)
    assert body is not None
    _, *lines = body[1].splitlines()
    return [line.strip() for line in lines]


def test_no_datagram_of_the_range_is_tracked() -> None:
    document = TABLE.made(FORWARDS, AROUND)
    assert not re.search("dnat|masquerade|snat|type nat|ct mark", document)
    assert rules("prerouting")[:5] == [
        'iif "lo" return',
        "meta l4proto != udp return",
        "udp dport != 45000-45999 return",
        "fib daddr type != local return",
        "notrack",
    ]


def test_the_port_is_rewritten_after_all_that_is_looked_up_by_it() -> None:
    for rule in rules("prerouting")[5:]:
        looked_up, rewritten = rule.split("udp dport set udp dport map @ports")
        assert "daddr set udp dport map @hosts" in looked_up
        assert "udp dport @received" in looked_up
        assert "dport" not in rewritten


def test_forwards_become_elements() -> None:
    assert elements(TABLE.made(FORWARDS, AROUND, counted=[45003])) == {
        "hosts4": "45001 : 10.0.0.5",
        "hosts6": "45002 : fd00::5",
        "ports": "45001 : 7411, 45002 : 7413",
        "received": "45001, 45002, 45003",
        "sources4": "10.0.0.5 . 7411 : 10.0.0.2",
        "sources6": "fd00::5 . 7413 : fd00::2",
    }


def test_a_locator_of_two_ports_has_one_source() -> None:
    adapted = TABLE.adapted({45001: FOUR, 45005: FOUR}, AROUND)
    assert elements(adapted) == {"sources4": "10.0.0.5 . 7411 : 10.0.0.2"}


def test_sources_are_replaced() -> None:
    flushed = [line for line in TABLE.adapted({}, AROUND).splitlines() if line]
    assert flushed == [f"flush map inet rosproxy-udp-45000 sources{version}" for version in (4, 6)]


def test_what_is_no_longer_forwarded_is_still_counted() -> None:
    deleted = elements(TABLE.changed(Changes({45001: FOUR}, {})), "delete")
    assert deleted == {"hosts4": "45001 : 10.0.0.5", "ports": "45001 : 7411"}


@pytest.mark.parametrize("host", ["robot", "10.0.0.5 }; flush ruleset", "fe80::1%}\nflush ruleset"])
def test_nothing_but_addresses_gets_into_a_document(host: str) -> None:
    around = Surroundings(sources={host: host})
    document = TABLE.made({45001: HostPort(host, 7411)}, around)
    assert "ruleset" not in document
    assert elements(document)["hosts4"] == "45001 : ?"


def printed(without: str = "", **elements_of: Any) -> str:
    """The output of ``nft -j list table``."""
    names = ("hosts4", "hosts6", "ports", "sources4", "sources6", "received")
    objects: list[Any] = [{"metainfo": {"version": "1.0.6", "json_schema_version": 1}}]
    for name in names:
        if name != without:
            body = {"family": "inet", "name": name, "table": "rosproxy-udp-45000"}
            body |= {"elem": elements_of[name]} if name in elements_of else {}
            objects.append({"set" if name == "received" else "map": body})
    return json.dumps({"nftables": objects})


def test_forwards_and_counters_are_read() -> None:
    text = printed(
        hosts4=[[45001, "10.0.0.5"], [45009, "10.0.0.9"]],
        hosts6=[[45002, "fd00::5"]],
        ports=[[45001, 7411], [45002, 7413]],
        sources4=[[{"concat": ["10.0.0.5", 7411]}, "10.0.0.2"]],
        received=[{"elem": {"val": 45001, "counter": {"packets": 3, "bytes": 700}}}],
    )
    assert TABLE.read(text) == TableState(FORWARDS, {45001: Counts(0, 700, 3)})


def test_a_table_of_another_kind_is_an_error() -> None:
    with pytest.raises(NftError):
        TABLE.read(printed(without="sources4"))
