"""A participant of Cyclone DDS with the names of ROS 2, in place of a node.

Takes the arguments of node.py and prints the same lines, for topics.
"""

import argparse
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


def say(*words: object) -> None:
    print(*words, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=["pub", "sub"])
    parser.add_argument("--name", required=True)
    parser.add_argument("--topic", default="/topic")
    parser.add_argument("--word", default="hello")
    parser.add_argument("--size", type=int, default=0)
    parser.add_argument("--period", type=float, default=0.1)
    parser.add_argument("--user-data", type=int, default=0, help="bytes told with the endpoint")
    options = parser.parse_args(sys.argv[1:])
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(10),
        Policy.Userdata(bytes(options.user_data)),
    )
    participant = DomainParticipant(0)
    topic = Topic(participant, "rt" + options.topic, String)
    if options.kind == "pub":
        publish(DataWriter(participant, topic, qos=qos), options)
    else:
        subscribe(DataReader(participant, topic, qos=qos))


def publish(writer: DataWriter, options: argparse.Namespace) -> None:
    number = 0
    while True:
        writer.write(String(f"{options.word} {number}".ljust(options.size, ".")))
        say("sent", number)
        number += 1
        time.sleep(options.period)


def subscribe(reader: DataReader) -> None:
    say("ready")
    while True:
        for sample in reader.take(10):
            if sample.sample_info.valid_data:  # otherwise a writer has gone
                text = sample.data.rstrip(".")
                say("got", text, "size", len(sample.data), "at", f"{time.time():.3f}")
        time.sleep(0.02)


if __name__ == "__main__":
    main()
