"""Many participants of Cyclone DDS in a process, or a participant that waits to discover them.

    ros2_crowd.py crowd COUNT     makes COUNT participants with a writer each
    ros2_crowd.py watch           prints when a reader has found how many writers

Runs with a Python that has cyclonedds, and imports nothing of this repository. Both print times of
the machine's clock.
"""

import signal
import sys
import time
from dataclasses import dataclass

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


@dataclass
class Text(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


def crowd(count: str) -> None:
    print("began", time.time(), flush=True)
    kept = []
    for _ in range(int(count)):
        participant = DomainParticipant(0)
        kept.append(DataWriter(participant, Topic(participant, "rt/crowd", Text)))
    signal.pause()


def watch() -> None:
    participant = DomainParticipant(0)
    reader = DataReader(participant, Topic(participant, "rt/crowd", Text))
    print("ready", flush=True)
    matched = 0
    while True:
        now = reader.get_subscription_matched_status().current_count
        if now != matched:
            matched = now
            print("found", matched, time.time(), flush=True)
        time.sleep(0.01)


if __name__ == "__main__":
    {"crowd": crowd, "watch": watch}[sys.argv[1]](*sys.argv[2:])
