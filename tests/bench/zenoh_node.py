"""Replacements for nodes of rmw_zenoh: sessions and keys with its defaults.

    zenoh_node.py talk NAME PEER              executes the commands of `talking`
    zenoh_node.py crowd COUNT HOST PORT       COUNT nodes, each a client of a port, from PORT on

Runs with a Python that has zenoh, with tests/zenoh/nodes in the path.
"""

from __future__ import annotations

import os
import sys
import threading
from typing import Any

from sessions import NODE, open_session
from talking import TOPICS, Talker, serve

_TYPE = "std_msgs::msg::dds_::String_"
_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def _key(name: str, topic: str) -> str:
    return f"0/{name}/{topic}/{_TYPE}/{_HASH}"


def talk(name: str, peer: str) -> None:
    session = open_session(NODE)
    publishers = {topic: session.declare_publisher(_key(name, topic)) for topic in TOPICS}
    talker = Talker(
        lambda topic, data: publishers[topic].put(data),
        lambda: all(publisher.matching_status.matching for publisher in publishers.values()),
    )

    def subscribe(topic: str) -> Any:
        def take(sample: Any) -> None:
            talker.take(topic, sample.payload.to_bytes())

        return session.declare_subscriber(_key(peer, topic), take)

    kept = [subscribe(topic) for topic in TOPICS]
    serve(talker)
    del kept


def crowd(count: str, host: str, port: str) -> None:
    kept = []
    for number in range(int(count)):
        endpoint = f'connect/endpoints=["tcp/{host}:{int(port) + number}"]'
        os.environ["ZENOH_CONFIG_OVERRIDE"] = f'mode="client";{endpoint}'
        session = open_session(NODE)
        zid = session.info.zid()
        token = f"@ros2_lv/0/{zid}/0/0/NN/%/%/node_{number}"
        kept.append((session, session.liveliness().declare_token(token)))
    print("ready", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    {"talk": talk, "crowd": crowd}[sys.argv[1]](*sys.argv[2:])
