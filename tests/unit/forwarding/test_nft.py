"""nftables: documents for nft, and JSON output recorded with nft 1.0.6."""

import contextlib
import json
import re
from ipaddress import ip_network
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.forwarding.kernel.connection_table import (
    NEW_BURST,
    NEW_PER_SECOND,
    ConnectionTable,
    Marks,
)
from rosproxy.forwarding.kernel.datagram_table import DatagramTable
from rosproxy.forwarding.kernel.decisions import Changes
from rosproxy.forwarding.kernel.nft import (
    Counts,
    NftError,
    Surroundings,
    TableState,
    dropping_chains,
)
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortRange

TABLE = ConnectionTable(11311, PortRange(45000, 45999))
NOTHING = Surroundings()
FOUR = HostPort("10.0.0.5", 50000)
SIX = HostPort("fd00::5", 50001)


def elements(document: str, verb: str) -> dict[str, list[str]]:
    """The elements that a document adds or deletes, by map and set."""
    statements = re.findall(
        rf"^{verb} element inet rosproxy-11311 (\w+) {{ (.*) }}$", document, re.M
    )
    return {name: text.split(", ") for name, text in statements}


def listing(document: str) -> str:
    """The output of ``nft -j list table`` after a document that makes the whole table."""
    elements_by_name = elements(document, "add")
    objects: list[Any] = [{"metainfo": {"version": "1.0.6"}}]
    for kind, name in re.findall(r"^  (map|set) (\w+) ", document, re.M):
        pairs = [text.split(" : ") for text in elements_by_name.get(name, []) if kind == "map"]
        shown = [[int(key), int(v) if v.isdigit() else v] for key, v in pairs]
        objects.append({kind: {"name": name, "table": "rosproxy-11311", "elem": shown}})
    return json.dumps({"nftables": objects})


@given(st.integers(1, 65535), st.integers(1, 65535), st.integers(1, 65535))
def test_marks_name_their_proxy_and_port(master: int, other: int, port: int) -> None:
    marks = Marks(master)
    assert 0 < marks.of(port) < 2**32
    assert marks.port(marks.of(port)) == port
    if other != master:
        assert Marks(other).port(marks.of(port)) is None
    value, _, mask = marks.table_selector.partition("/")
    assert marks.of(port) & int(mask, 16) == int(value, 16)
    assert int(marks.port_selector(port).partition("/")[0], 16) == marks.of(port)


def test_the_whole_table_takes_the_place_of_an_old_one() -> None:
    document = TABLE.made({}, NOTHING)
    name = "table inet rosproxy-11311"
    assert document.splitlines()[:3] == [f"add {name}", f"delete {name}", f"{name} {{"]
    assert re.findall(r"chain (\w+) {\n *type (\w+) hook \1 priority (\S+);", document) == [
        ("prerouting", "nat", "-100"),
        ("postrouting", "nat", "100"),
        ("forward", "filter", "-300"),
    ]
    assert document.count("policy accept;") == document.count("policy") == 3
    assert elements(document, "add") == {}


def test_forwards_become_elements() -> None:
    document = TABLE.made({45050: FOUR, 45051: SIX}, NOTHING, counted=[45052])
    marks = [str(TABLE.marks.of(port)) for port in (45050, 45051, 45052)]
    assert elements(document, "add") == {
        "marks": [f"45050 : {marks[0]}", f"45051 : {marks[1]}"],
        "hosts4": ["45050 : 10.0.0.5"],
        "hosts6": ["45051 : fd00::5"],
        "ports": ["45050 : 50000", "45051 : 50001"],
        "sent": marks,
        "received": marks,
    }


def test_what_leads_outside_is_open_to_those_who_are_near_alone() -> None:
    near = [ip_network("172.30.0.0/16"), ip_network("fd30::/64")]
    made = TABLE.made({45050: FOUR, 26400: SIX}, Surroundings(near))
    assert elements(made, "add")["inward"] == ["26400"]
    rules = re.search(r"chain prerouting {(.*?)}", made, re.S)
    assert rules is not None
    first, second, third = rules[1].strip().splitlines()[1:4]
    assert first.strip() == "tcp dport @inward ip saddr != @near4 return"
    assert second.strip() == "tcp dport @inward ip6 saddr != @near6 return"
    assert "tcp dport map @marks" in third
    opened = TABLE.adapted({}, Surroundings(near))
    assert opened.count("flush set inet rosproxy-11311 near") == 2
    for document in (made, opened):
        assert elements(document, "add")["near4"] == ["172.30.0.0/16"]
        assert elements(document, "add")["near6"] == ["fd30::/64"]
    assert elements(TABLE.changed(Changes({26400: SIX}, {})), "delete")["inward"] == ["26400"]
    assert "near4" not in elements(TABLE.adapted({}, NOTHING), "add")


def test_new_connections_have_a_limit_before_they_are_led_elsewhere() -> None:
    """Forged SYNs took all ports of the masquerade, at some 540 a second."""
    rules = re.search(r"chain prerouting {(.*?)}", TABLE.made({45050: FOUR}, NOTHING), re.S)
    assert rules is not None
    marked, limited, *led = rules[1].strip().splitlines()[3:]
    assert "ct mark set tcp dport map @marks" in marked
    assert f"limit rate over {NEW_PER_SECOND}/second" in limited
    assert limited.endswith("ct mark set 0 return")
    assert f"{TABLE.marks.of(0):#x}" in limited
    assert ["dnat" in rule for rule in led] == [True, True]
    longest_half_open_s = 120
    assert NEW_BURST + NEW_PER_SECOND * longest_half_open_s < 64_512 / 2


@pytest.mark.parametrize("host", ["robot", "10.0.0.5 }; flush ruleset", "fe80::1%}\nflush ruleset"])
def test_nothing_but_addresses_gets_into_a_document(host: str) -> None:
    document = TABLE.made({45050: HostPort(host, 50000)}, NOTHING)
    assert elements(document, "add")["hosts4"] == ["45050 : ?"]
    assert "ruleset" not in document


def test_a_change_takes_out_before_it_puts_in() -> None:
    document = TABLE.changed(Changes({45050: FOUR}, {45050: SIX}))
    assert [line.split()[0] for line in document.splitlines()] == ["delete"] * 3 + ["add"] * 5
    assert elements(document, "delete") == {
        "marks": [f"45050 : {TABLE.marks.of(45050)}"],
        "hosts4": ["45050 : 10.0.0.5"],
        "ports": ["45050 : 50000"],
    }
    assert elements(document, "add")["hosts6"] == ["45050 : fd00::5"]


def test_what_is_no_longer_forwarded_is_still_counted() -> None:
    document = TABLE.changed(Changes({45050: FOUR}, {}))
    assert {"sent", "received"}.isdisjoint(elements(document, "delete"))


def test_connections_that_are_cut_are_reset_for_who_has_connected() -> None:
    reset = "ct direction original ct mark @cut reject with tcp reset"
    assert reset in TABLE.made({}, NOTHING)
    marks = [str(TABLE.marks.of(port)) for port in (26400, 45050)]
    assert elements(TABLE.cut({45050, 26400}), "add") == {"cut": marks}
    assert elements(TABLE.cut({45050, 26400}, "delete"), "delete") == {"cut": marks}


def test_ending_forwards_nothing_new_and_resets_what_comes() -> None:
    *flushed, rule = TABLE.ended().splitlines()
    maps = ("marks", "hosts4", "hosts6", "ports")
    assert flushed == [f"flush map inet rosproxy-11311 {name}" for name in maps]
    assert rule.startswith("add rule inet rosproxy-11311 forward ct status dnat")
    assert rule.endswith(" reject with tcp reset")


def test_a_table_leaves_udp_alone() -> None:
    made = TABLE.made({45050: FOUR}, NOTHING)
    assert not re.search(r"\budp dport|l4proto udp", made)
    chains = dict(re.findall(r"chain (\w+) {\n(.*?)\n  }", made, re.S))
    for name in ("postrouting", "forward"):
        rules = [line for line in chains[name].splitlines() if "ct status dnat" in line]
        assert rules
        assert all("meta l4proto tcp " in line for line in rules)
    prerouting = chains["prerouting"].splitlines()[1:]
    assert all("tcp dport" in line or "l4proto tcp" in line for line in prerouting)


def test_tables_of_both_transports_have_names_of_their_own() -> None:
    same = DatagramTable(PortRange(11311, 11399))
    assert (TABLE.name, same.name) == ("rosproxy-11311", "rosproxy-udp-11311")


def test_removing() -> None:
    assert TABLE.removed() == "delete table inet rosproxy-11311\n"


PORTS = st.integers(1, 65535)


@given(st.dictionaries(PORTS, st.builds(HostPort, st.sampled_from(["10.0.0.5", "fd00::5"]), PORTS)))
def test_what_is_made_is_read_back(forwards: dict[int, HostPort]) -> None:
    read = TABLE.read(listing(TABLE.made(forwards, NOTHING)))
    assert read == TableState(forwards, {})


def printed(**elements_of: Any) -> str:
    names = ("marks", "hosts4", "hosts6", "ports", "sent", "received")
    objects: list[Any] = [{"metainfo": {"version": "1.0.6", "json_schema_version": 1}}]
    for name in names:
        body = {"family": "inet", "name": name, "table": "rosproxy-11311"}
        if name in elements_of:
            body["elem"] = elements_of[name]
        objects.append({"set" if name in ("sent", "received") else "map": body})
    return json.dumps({"nftables": objects})


def counter(mark: int, size: int) -> dict[str, Any]:
    return {"elem": {"val": mark, "counter": {"packets": 3, "bytes": size}}}


def test_counters_are_read_by_port() -> None:
    mark = TABLE.marks.of
    text = printed(
        sent=[counter(mark(45050), 700), counter(mark(45051), 5), counter(7, 9)],
        received=[counter(mark(45050), 80), {"elem": {"val": mark(45052)}}, "odd", 4],
    )
    assert TABLE.read(text).counters == {
        45050: Counts(700, 80, 3),
        45051: Counts(5),
        45052: Counts(),
    }


def test_elements_that_do_not_fit_together_are_left_out() -> None:
    text = printed(
        marks=[[45050, TABLE.marks.of(45050)], [45051, 5], [45052, TABLE.marks.of(45052)]],
        hosts4=[[45050, "10.0.0.5"], [45051, "10.0.0.5"], [45052, "not an address"], "odd"],
        ports=[[45050, 50000], [45051, 50000], [45052, 50000], ["a", 1], [1]],
    )
    assert TABLE.read(text).forwards == {45050: FOUR}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[]",
        '{"nftables": 5}',
        '{"nftables": [5]}',
        '{"nftables": [{"metainfo": {}}]}',
        "Error: no such table",
    ],
)
def test_what_nft_should_not_print_is_an_error(text: str) -> None:
    with pytest.raises(NftError):
        TABLE.read(text)


KEYS = ("nftables", "map", "set", "chain", "name", "elem", "val", "counter", "bytes")
ANYTHING = st.recursive(
    st.none() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(KEYS), inner),
)


@given(ANYTHING)
def test_nothing_that_is_read_breaks_it(value: Any) -> None:
    for text in (json.dumps(value), json.dumps({"nftables": value})):
        for read in (TABLE.read, dropping_chains):
            with contextlib.suppress(NftError):
                read(text)


@given(st.dictionaries(st.sampled_from(["marks", "hosts4", "ports", "sent", "received"]), ANYTHING))
def test_no_elements_break_it(elements_of: dict[str, Any]) -> None:
    assert TABLE.read(printed(**elements_of)).forwards == {}


def test_chains_that_drop_what_is_forwarded() -> None:
    def chain(table: str, **more: str) -> dict[str, Any]:
        return {"chain": {"family": "ip", "table": table, "name": "C", **more}}

    text = json.dumps(
        {
            "nftables": [
                {"metainfo": {}},
                chain("filter", hook="forward", policy="drop"),
                chain("other", hook="forward", policy="accept"),
                chain("input", hook="input", policy="drop"),
                chain("plain"),
            ]
        }
    )
    assert dropping_chains(text) == ["ip filter C"]
