"""Asks the routers outside for their sessions: which programs are zenoh peers of such a router.

A router passes no data between two of its own peers, and rmw_zenoh makes each node a peer. The
proxy has no part in the sessions of a router outside. But rmw_zenohd describes itself in zenoh's
admin space at ``@/ZID/router``, and a node at ``@/ZID/peer``. The hub asks both.
"""

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

ASK_INTERVAL_S = 5.0
"""Seconds between two questions to a router outside, and to the peers of such a router."""
ANSWER_TIMEOUT_S = 4.0
"""Seconds in which a router outside, or a node, has to answer."""
MOST_ASKED_PEERS = 100
"""Zenoh peers of routers outside that the hub asks at a time."""
LONGEST_ANSWER = 1024 * 1024
"""Bytes of an answer. A session takes some 200."""
MOST_SESSIONS = 2000
"""Sessions of routers and nodes outside in a report."""
LONGEST_SESSION = 500
"""Characters of such a session as JSON, in a report."""
PEER = "peer"
ROUTER = "router"
_Description = dict[str, Any]
"""A zenoh ID (``zid``) and its ``sessions``, as in a `RouterReport`."""


class OutsideRouters:
    """The answers of the routers outside with which the hub has a session, and of their peers."""

    def __init__(self) -> None:
        self._routers: dict[str, _Description] = {}
        self._peers: dict[str, _Description] = {}
        self._asked_at = float("-inf")

    def look(self, hub: Any, described: Sequence[Mapping[str, Any]], now: float) -> None:
        """Ask, if it is time. ``described`` are the own routers; the last is the hub."""
        if now < self._asked_at + ASK_INTERVAL_S:
            return
        self._asked_at = now
        own = {router["zid"] for router in described}
        sessions = described[-1]["sessions"] if described else ()
        routers = {s["peer"] for s in sessions if s["whatami"] == ROUTER} - own
        self._routers = _only(self._routers, routers)
        peers = sorted({zid for router in self._routers.values() for zid in _remote_peers(router)})
        self._peers = _only(self._peers, peers[:MOST_ASKED_PEERS])
        for mode, zids, answers in (
            (ROUTER, routers, self._routers),
            (PEER, peers[:MOST_ASKED_PEERS], self._peers),
        ):
            for zid in zids:
                take = partial(self._take, answers, zid, described[-1]["zid"])
                hub.get(f"@/{zid}/{mode}", take, timeout=ANSWER_TIMEOUT_S)

    def report(self) -> list[_Description]:
        """The latest descriptions, with MOST_SESSIONS in all.

        A peer is left out rather than cut: a session that is missing would count as a fault.
        """
        room = MOST_SESSIONS
        reported = []
        for router in [*self._routers.values()]:
            sessions = router["sessions"][:room]
            room -= len(sessions)
            reported.append({**router, "sessions": sessions})
        for peer in [*self._peers.values()]:
            if len(peer["sessions"]) <= room:
                room -= len(peer["sessions"])
                reported.append(peer)
        return reported

    def _take(self, answers: dict[str, _Description], zid: str, hub: str, reply: Any) -> None:
        """Note an answer. A thread of zenoh calls this."""
        payload = reply.ok.payload.to_bytes() if reply.ok is not None else b""
        if 0 < len(payload) <= LONGEST_ANSWER:
            with contextlib.suppress(ValueError):
                answers[zid] = {"zid": zid, "sessions": _sessions(payload, hub)}


def _only(answers: Mapping[str, _Description], zids: Iterable[str]) -> dict[str, _Description]:
    return {zid: answers[zid] for zid in zids if zid in answers}


def _sessions(payload: bytes, hub: str) -> list[dict[str, Any]]:
    """The first MOST_SESSIONS sessions of an answer with zenoh peers and with the hub.

    Raises ValueError if the answer is not valid. Any program in the zenoh network may answer, and a
    report that is not valid ends the routers. So each value is checked.
    """
    try:
        sessions = json.loads(payload)["sessions"]
        kept = (_kept(s) for s in sessions if s["whatami"] == PEER or s["peer"] == hub)
        short = (session for session in kept if len(json.dumps(session)) <= LONGEST_SESSION)
        return [*islice(short, MOST_SESSIONS)]
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"an answer that is not valid: {error!r}") from None


def _kept(session: Mapping[str, Any]) -> dict[str, Any]:
    """What a report has of a session. Raises ValueError, KeyError, TypeError."""
    links = [{"src": str(link["src"]), "dst": str(link["dst"])} for link in session["links"][:1]]
    kept = {"peer": str(session["peer"]), "whatami": str(session["whatami"]), "links": links}
    # JSON may have halves of characters (``\ud800``), which the proxy can't read.
    json.dumps(kept, ensure_ascii=False).encode()
    return kept


def _remote_peers(router: Mapping[str, Any]) -> Iterator[str]:
    """Yield the zenoh IDs of the peers on other machines than the router."""
    for session in router["sessions"]:
        hosts = {host_of(end) for link in session["links"] for end in link.values()}
        if session["whatami"] == PEER and len(hosts) > 1 and _is_zid(session["peer"]):
            yield session["peer"]


def host_of(locator: str) -> str:
    """The host in a locator such as ``tcp/192.0.2.7:7447``."""
    return locator.partition("/")[2].rpartition(":")[0]


def _is_zid(text: str) -> bool:
    """Whether a text may be a part of a key expression."""
    return 0 < len(text) <= 32 and text.isascii() and text.isalnum()
