"""The hub asks routers outside and their peers, and reports only what is valid and short."""

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from rosproxy.zenoh.outside_routers import ASK_INTERVAL_S, MOST_SESSIONS, OutsideRouters
from rosproxy.zenoh.protocol.report import read_report

OWN = {"zid": "01", "sessions": []}
HUB = {
    "zid": "03",
    "sessions": [
        {"peer": "01", "whatami": "router", "links": []},
        {"peer": "04", "whatami": "router", "links": []},
    ],
}


class Payload(NamedTuple):
    """The payload of an answer."""

    text: str

    def to_bytes(self) -> bytes:
        return self.text.encode()


class Sample(NamedTuple):
    """An answer."""

    payload: Payload


class Reply(NamedTuple):
    """A reply: an answer, or none."""

    ok: Sample | None


class FakeHub:
    """A hub whose questions get texts by key."""

    def __init__(self, answers: dict[str, str]) -> None:
        self.answers = answers
        self.asked: list[str] = []

    def get(self, key: str, take: Callable[[Reply], None], timeout: float) -> None:
        self.asked.append(key)
        text = self.answers.get(key)
        take(Reply(None if text is None else Sample(Payload(text))))


def session(zid: str, mode: str, remote: str, local: str = "192.0.2.7") -> dict[str, Any]:
    links = [{"src": f"tcp/{local}:7447", "dst": f"tcp/{remote}:50000"}]
    return {"peer": zid, "whatami": mode, "links": links, "shm": False}


def reported(answers: dict[str, str]) -> list[dict[str, Any]]:
    """The report after two looks."""
    outside = OutsideRouters()
    for look in range(2):
        outside.look(FakeHub(answers), [OWN, HUB], look * ASK_INTERVAL_S)
    report = outside.report()
    read_report(json.dumps({"outside": report}).encode())
    return report


def test_peers_and_the_hub_are_reported_and_clients_are_not() -> None:
    sessions = [
        session("a1", "peer", "127.0.0.1", "127.0.0.1"),
        session("b1", "peer", "192.0.2.10"),
        session("03", "router", "192.0.2.10"),
        session("c1", "client", "192.0.2.20"),
        session("05", "router", "192.0.2.30"),
    ]
    of_peer = [session("a1", "peer", "192.0.2.7", "192.0.2.10")]
    router, peer = reported(
        {
            "@/04/router": json.dumps({"sessions": sessions}),
            "@/b1/peer": json.dumps({"sessions": of_peer}),
        }
    )
    assert router["zid"] == "04"
    assert [s["peer"] for s in router["sessions"]] == ["a1", "b1", "03"]
    assert (peer["zid"], [s["peer"] for s in peer["sessions"]]) == ("b1", ["a1"])


def test_only_routers_outside_and_remote_peers_are_asked() -> None:
    sessions = [
        session("a1", "peer", "127.0.0.1", "127.0.0.1"),
        session("b1", "peer", "192.0.2.10"),
        session("**", "peer", "192.0.2.10"),
    ]
    hub = FakeHub({"@/04/router": json.dumps({"sessions": sessions})})
    outside = OutsideRouters()
    outside.look(hub, [OWN, HUB], 0.0)
    outside.look(hub, [OWN, HUB], ASK_INTERVAL_S / 2)
    assert hub.asked == ["@/04/router"]
    outside.look(hub, [OWN, HUB], ASK_INTERVAL_S)
    assert hub.asked[1:] == ["@/04/router", "@/b1/peer"]


def test_a_router_that_is_gone_is_not_reported() -> None:
    hub = FakeHub({"@/04/router": json.dumps({"sessions": [session("b1", "peer", "192.0.2.10")]})})
    outside = OutsideRouters()
    outside.look(hub, [OWN, HUB], 0.0)
    assert outside.report()
    outside.look(hub, [OWN, {**HUB, "sessions": []}], ASK_INTERVAL_S)
    assert not outside.report()


@pytest.mark.parametrize(
    "answer",
    [
        "no JSON",
        "[]",
        "7",
        "{}",
        '{"sessions": 7}',
        '{"sessions": [7]}',
        '{"sessions": [{"whatami": "peer"}]}',
        '{"sessions": [{"whatami": "peer", "peer": "b1", "links": [7]}]}',
        "[" * 100_000,
        json.dumps({"sessions": [session("b1", "peer", "x" * 500)]}),
        json.dumps({"sessions": [session("b1", "peer", "192.0.2.10")] * 10_000}),
        json.dumps({"sessions": [session("\ud800", "peer", "192.0.2.10")]}),
        json.dumps({"sessions": [session("b1", "peer", "192.0.2.10\udfff")]}),
        '{"sessions": [{"whatami": "peer", "peer": 1%s, "links": []}]}' % ("0" * 5000),
    ],
    ids=range(14),
)
def test_an_answer_that_is_not_valid_or_too_long_tells_nothing(answer: str) -> None:
    assert not [
        s for description in reported({"@/04/router": answer}) for s in description["sessions"]
    ]


def test_values_of_other_types_do_not_end_the_report() -> None:
    odd = {"whatami": "peer", "peer": 7, "links": [{"src": None, "dst": []}]}
    (router,) = reported({"@/04/router": json.dumps({"sessions": [odd]})})
    assert router["sessions"] == [
        {"peer": "7", "whatami": "peer", "links": [{"src": "None", "dst": "[]"}]}
    ]


def test_the_sessions_that_are_kept_of_an_answer_are_bounded() -> None:
    """Otherwise the answers of a hundred peers would take a gigabyte."""
    tiny = json.dumps({"sessions": [{"whatami": "peer", "peer": "", "links": []}] * 20_000})
    outside = OutsideRouters()
    outside.look(FakeHub({"@/04/router": tiny}), [OWN, HUB], 0.0)
    (kept,) = vars(outside)["_routers"].values()
    assert len(kept["sessions"]) == MOST_SESSIONS


def test_the_sessions_of_a_report_are_bounded() -> None:
    many = [session(f"{n:x}", "peer", "192.0.2.7") for n in range(MOST_SESSIONS + 10)]
    (router,) = reported({"@/04/router": json.dumps({"sessions": many})})
    assert len(router["sessions"]) == MOST_SESSIONS


def test_a_peer_with_too_many_sessions_for_a_report_is_left_out() -> None:
    """Otherwise the peer would seem to have no session with other peers."""
    many = [session(f"{n:x}", "peer", "192.0.2.7") for n in range(MOST_SESSIONS)]
    (router,) = reported(
        {
            "@/04/router": json.dumps({"sessions": [session("b1", "peer", "192.0.2.10")]}),
            "@/b1/peer": json.dumps({"sessions": many}),
        }
    )
    assert router["zid"] == "04"
