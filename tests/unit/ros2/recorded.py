"""Datagrams of real participants, recorded by ``tests/ros2/record.py``."""

from pathlib import Path

import msgspec

FOLDER = Path(__file__).parent / "recordings"
VENDORS = "cyclone", "jazzy", "kilted"
"""The implementations: Cyclone DDS, Fast DDS 2.14 and 3.2."""
PUBLISHER = "172.30.1.11"
SUBSCRIBER = "172.30.1.12"


class Datagram(msgspec.Struct, frozen=True):
    """A datagram. ``source`` and ``target`` are ``host:port``, ``payload`` is in hex."""

    source: str
    target: str
    payload: str

    @property
    def host(self) -> str:
        """The host of the source."""
        return self.source.partition(":")[0]

    @property
    def content(self) -> bytes:
        """The message."""
        return bytes.fromhex(self.payload)


def recorded(vendor: str) -> list[Datagram]:
    """The recorded datagrams of an implementation, in the order of sending."""
    lines = (FOLDER / f"{vendor}.jsonl").read_bytes()
    return msgspec.json.Decoder(Datagram).decode_lines(lines)
