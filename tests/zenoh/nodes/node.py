"""A replacement for a node of rmw_zenoh: session, keys and liveliness tokens.

`python node.py KIND NAME TOPIC`, where KIND is pub, sub, serve, call or graph. Prints a line for
each event, and runs until killed.
"""

import sys
import threading
import time
from typing import Any

import zenoh
from sessions import NODE, open_session

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
TYPE = "std_msgs::msg::dds_::String_"
PERIOD_S = 0.1


def say(*words: object) -> None:
    print(*words, flush=True)


def graph_change(sample: Any) -> None:
    name = str(sample.key_expr).split("/")[8]
    say("gone" if sample.kind == zenoh.SampleKind.DELETE else "seen", name)


def call(session: Any, key: str) -> None:
    while True:
        for reply in session.get(key, timeout=1.0):
            if reply.ok is not None:
                say(reply.ok.payload.to_string())
        time.sleep(PERIOD_S)


def publish(session: Any, key: str) -> None:
    publisher = session.declare_publisher(key)
    number = 0
    while True:
        publisher.put(f"hello {number}")
        number += 1
        time.sleep(PERIOD_S)


def main(kind: str, name: str, topic: str) -> None:
    session = open_session(NODE)
    zid = session.info.zid()
    key = f"0/{topic}/{TYPE}/{HASH}"
    node = session.liveliness().declare_token(f"@ros2_lv/0/{zid}/0/0/NN/%/%/{name}")
    held = [node]
    if kind in ENTITIES:
        token = (
            f"@ros2_lv/0/{zid}/0/1/{ENTITIES[kind]}/%/%/{name}/%{topic}/{TYPE}/{HASH}/::,10:,:,:,,"
        )
        held.append(session.liveliness().declare_token(token))
    say("ready")
    if kind == "pub":
        publish(session, key)
    if kind == "call":
        call(session, key)
    if kind == "sub":
        held.append(session.declare_subscriber(key, lambda s: say("got", s.payload.to_string())))
    if kind == "serve":
        held.append(
            session.declare_queryable(key, lambda query: query.reply(key, f"answer of {name}"))
        )
    if kind == "graph":
        held.append(
            session.liveliness().declare_subscriber("@ros2_lv/0/**", graph_change, history=True)
        )
    threading.Event().wait()


ENTITIES = {"pub": "MP", "sub": "MS", "serve": "SS", "call": "SC"}

if __name__ == "__main__":
    main(*sys.argv[1:])
