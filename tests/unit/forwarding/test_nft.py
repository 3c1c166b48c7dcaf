"""nftables' JSON: documents as nft takes them, output as nft 1.0.6 printed it."""

import contextlib
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.forwarding.kernel.nft import Marks, NftError, Table, TableState, dropping_chains
from rosproxy.forwarding.kernel.policy import Changes
from rosproxy.net.addresses import HostPort

TABLE = Table(11311)
FOUR, SIX = HostPort("10.0.0.5", 50000), HostPort("fd00::5", 50001)


def commands(document: str) -> list[tuple[str, str, Any]]:
    return [
        (verb, kind, body)
        for command in json.loads(document)["nftables"]
        for verb, rest in command.items()
        for kind, body in rest.items()
    ]


def elements(document: str, verb: str) -> dict[str, Any]:
    return {
        body["name"]: body["elem"]
        for said, kind, body in commands(document)
        if (said, kind) == (verb, "element")
    }


def listing(document: str) -> str:
    """What ``nft -j list table`` prints after a document that makes the whole table."""
    held = elements(document, "add")
    objects = [
        {kind: body | ({"elem": held[body["name"]]} if body["name"] in held else {})}
        for verb, kind, body in commands(document)
        if verb == "add" and kind in ("map", "set")
    ]
    return json.dumps({"nftables": [{"metainfo": {"version": "1.0.6"}}, *objects]})


@given(st.integers(1, 65535), st.integers(1, 65535), st.integers(1, 65535))
def test_marks_name_their_proxy_and_port(master: int, other: int, port: int) -> None:
    marks = Marks(master)
    assert 0 < marks.of(port) < 2**32
    assert marks.port(marks.of(port)) == port
    if other != master:
        assert Marks(other).port(marks.of(port)) is None
    value, _, mask = marks.all.partition("/")
    assert marks.of(port) & int(mask, 16) == int(value, 16)
    assert int(marks.one(port).partition("/")[0], 16) == marks.of(port)


def test_the_whole_table_takes_the_place_of_an_old_one() -> None:
    said = commands(TABLE.made({}))
    table = {"family": "inet", "name": "rosproxy-11311"}
    assert said[:3] == [("add", "table", table), ("delete", "table", table), said[0]]
    assert {kind for _, kind, _ in said[3:]} == {"map", "set", "chain", "rule"}
    chains = {b["name"]: (b["type"], b["prio"]) for _, kind, b in said if kind == "chain"}
    assert chains == {
        "prerouting": ("nat", -100),
        "postrouting": ("nat", 100),
        "forward": ("filter", -300),
    }
    assert all(b["policy"] == "accept" for _, kind, b in said if kind == "chain")


def test_forwards_become_elements() -> None:
    document = TABLE.made({45050: FOUR, 45051: SIX}, counted=[45052])
    marks = [TABLE.marks.of(port) for port in (45050, 45051, 45052)]
    assert elements(document, "add") == {
        "marks": [[45050, marks[0]], [45051, marks[1]]],
        "hosts4": [[45050, "10.0.0.5"]],
        "hosts6": [[45051, "fd00::5"]],
        "ports": [[45050, 50000], [45051, 50001]],
        "sent": marks,
        "received": marks,
    }


def test_a_change_takes_out_before_it_puts_in() -> None:
    document = TABLE.changed(Changes({45050: FOUR}, {45050: SIX}))
    assert [verb for verb, _, _ in commands(document)] == ["delete"] * 3 + ["add"] * 5
    assert elements(document, "delete") == {
        "marks": [[45050, TABLE.marks.of(45050)]],
        "hosts4": [[45050, "10.0.0.5"]],
        "ports": [[45050, 50000]],
    }
    assert elements(document, "add")["hosts6"] == [[45050, "fd00::5"]]


def test_what_is_no_longer_forwarded_is_still_counted() -> None:
    document = TABLE.changed(Changes({45050: FOUR}, {}))
    assert {"sent", "received"}.isdisjoint(elements(document, "delete"))


def test_ending_forwards_nothing_new_and_resets_what_comes() -> None:
    *flushed, (verb, kind, rule) = commands(TABLE.ended())
    assert [(said[:2], said[2]["name"]) for said in flushed] == [
        (("flush", "map"), name) for name in ("marks", "hosts4", "hosts6", "ports")
    ]
    assert (verb, kind, rule["chain"]) == ("add", "rule", "forward")
    assert rule["expr"][-1] == {"reject": {"type": "tcp reset"}}


def test_removing() -> None:
    body = {"family": "inet", "name": "rosproxy-11311"}
    assert commands(TABLE.removed()) == [("delete", "table", body)]


PORTS = st.integers(1, 65535)


@given(st.dictionaries(PORTS, st.builds(HostPort, st.sampled_from(["10.0.0.5", "fd00::5"]), PORTS)))
def test_what_is_made_is_read_back(forwards: dict[int, HostPort]) -> None:
    read = TABLE.read(listing(TABLE.made(forwards)))
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
    assert TABLE.read(text).counters == {45050: (700, 80), 45051: (5, 0), 45052: (0, 0)}


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
