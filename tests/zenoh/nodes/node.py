"""A replacement for a node of rmw_zenoh: session, keys and liveliness tokens.

`python node.py KIND NAME TOPIC`, where KIND is pub, blast, shout, sub, count, clock, latch, late,
serve, usurp, call, probe, graph, crowd, hoard, mute, offer or use. Prints a line for each event,
and runs until killed. NODE_TYPE: another type, as in keys. NODE_PERIOD_S: the time between two
messages. NODE_TOKENS, NODE_LETTER: see `crowd`. NODE_BYTES: see `blast`. For `offer` and `use`,
which gets names of nodes as TOPIC, see `matrix.py`.
"""

import itertools
import json
import os
import socket
import sys
import threading
import time
from typing import Any

import zenoh
from matrix import HASH, offer, say, use
from sessions import NODE, open_session
from zenoh import ext

TYPE = os.environ.get("NODE_TYPE", "std_msgs::msg::dds_::String_")
PERIOD_S = float(os.environ.get("NODE_PERIOD_S", "0.1"))


def graph_change(sample: Any) -> None:
    parts = str(sample.key_expr).split("/")
    is_end = sample.kind == zenoh.SampleKind.DELETE
    say("gone" if is_end else "seen", parts[8])
    if len(parts) > 9:
        say("unlisted" if is_end else "listed", parts[8], parts[5], parts[9])


def call(session: Any, key: str) -> None:
    while True:
        for reply in session.get(key, timeout=1.0):
            if reply.ok is not None:
                say(reply.ok.payload.to_string())
        say("asked")
        time.sleep(PERIOD_S)


def publish(session: Any, key: str) -> None:
    publisher = session.declare_publisher(key)
    number = 0
    while True:
        publisher.put(f"hello {number}")
        if number == 2:
            say("said")
        number += 1
        time.sleep(PERIOD_S)


def blast(session: Any, key: str) -> None:
    """Publish messages at full rate, as rmw_zenoh does with reliable and keep_all.

    NODE_BYTES has the sizes in turn, separated by commas.
    """
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    contents = [bytes(int(size)) for size in os.environ["NODE_BYTES"].split(",")]
    for content in itertools.cycle(contents):
        publisher.put(content)


def subscribe(session: Any, key: str, _: str) -> Any:
    return session.declare_subscriber(key, lambda s: say("got", s.payload.to_string()))


def hoard(_: Any, __: str) -> None:
    """Take all sessions and connections that the router accepts, again and again."""
    held: list[Any] = []
    while True:
        try:
            held.append(open_session(NODE | {"mode": '"client"', "listen/endpoints": "[]"}))
        except zenoh.ZError:
            say("refused")
            held += [socket.create_connection(("localhost", 7447)) for _ in range(20)]
            time.sleep(PERIOD_S)


def count(session: Any, key: str, _: str) -> Any:
    """Subscribe, and print the number of bytes of each message."""
    return session.declare_subscriber(key, lambda s: say("got", len(s.payload.to_bytes())))


def clock(session: Any, key: str, _: str) -> Any:
    """Subscribe, and print the time of each message in seconds, on the clock of the machine."""
    return session.declare_subscriber(key, lambda _: say("at", f"{time.monotonic():.3f}"))


def serve(session: Any, key: str, name: str) -> Any:
    return session.declare_queryable(key, lambda query: query.reply(key, f"answer of {name}"))


def usurp(session: Any, _: str, __: str) -> Any:
    """Answer for the routers: with nonsense, and with a session that the router does not have."""

    def answer(query: Any) -> None:
        say("asked", query.key_expr)
        zid = str(query.key_expr).split("/")[1]
        link = {"src": "tcp/192.0.2.1:7448", "dst": "tcp/192.0.2.9:1"}
        invented = {"peer": "f00", "whatami": "router", "links": [link]}
        described = {"zid": zid, "sessions": [invented], "locators": []}
        query.reply(query.key_expr, json.dumps(described))

    return session.declare_queryable("@/**", answer, complete=True)


def crowd(session: Any, _: str, name: str) -> list[Any]:
    """Declare NODE_TOKENS tokens of topics, whose names end in NODE_LETTER, 800 times."""
    start = f"@ros2_lv/0/{session.info.zid()}/0"
    end = f"{800 * os.environ['NODE_LETTER']}/{TYPE}/{HASH}/::"
    tokens = []
    for number in range(int(os.environ["NODE_TOKENS"])):
        key = f"{start}/{number}/MP/%/%/{name}/%t{number:04d}{end}"
        tokens.append(session.liveliness().declare_token(key))
        time.sleep(0.001)  # a full queue would end the session
    say("declared")
    return tokens


def watch_graph(session: Any, _: str, __: str) -> Any:
    return session.liveliness().declare_subscriber("@ros2_lv/0/**", graph_change, history=True)


def latch(session: Any, key: str, _: str) -> Any:
    """Publish as rmw_zenoh does with the durability transient_local."""
    latched = ext.declare_advanced_publisher(
        session, key, cache=ext.CacheConfig(1), publisher_detection=True
    )
    latched.put("latched")
    say("latched")
    return latched


def subscribe_late(session: Any, key: str, _: str) -> Any:
    """Subscribe as rmw_zenoh does with the durability transient_local."""
    history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    return ext.declare_advanced_subscriber(
        session, key, lambda s: say("got", s.payload.to_string()), history=history
    )


def main(kind: str, name: str, topic: str) -> None:
    session = open_session(NODE)
    zid = session.info.zid()
    key = f"0/{topic}/{TYPE}/{HASH}"
    held = []
    if kind != "mute":  # as a program that is no node
        node = f"@ros2_lv/0/{zid}/0/0/NN/%/%/{name}"
        held.append(session.liveliness().declare_token(node))
    if kind in ENTITIES:
        mangled = f"/{topic}".replace("/", "%")
        token = (
            f"@ros2_lv/0/{zid}/0/1/{ENTITIES[kind]}/%/%/{name}/{mangled}/{TYPE}/{HASH}/::,10:,:,:,,"
        )
        held.append(session.liveliness().declare_token(token))
    if kind in MATRIX:
        held.append(watch_graph(session, topic, name))
        MATRIX[kind](session, name, topic)
    say("ready")
    if kind in RUNS:
        RUNS[kind](session, key)
    if kind in DECLARES:
        held.append(DECLARES[kind](session, key, name))
    threading.Event().wait()


ENTITIES = {
    **dict.fromkeys(("pub", "blast", "latch"), "MP"),
    **dict.fromkeys(("sub", "count", "clock", "late"), "MS"),
    "serve": "SS",
    "call": "SC",
}
RUNS = {
    "pub": publish,
    "blast": blast,
    "hoard": hoard,
    "shout": publish,
    "call": call,
    "probe": call,
}
"""`shout` and `probe` have no token, so their topic may have wildcards."""
MATRIX = {"offer": offer, "use": use}
"""Both watch the graph, as each node of rmw_zenoh does."""
DECLARES = {
    "sub": subscribe,
    "count": count,
    "clock": clock,
    "serve": serve,
    "usurp": usurp,
    "graph": watch_graph,
    "crowd": crowd,
    "latch": latch,
    "late": subscribe_late,
}

if __name__ == "__main__":
    main(*sys.argv[1:])
