"""Datagrams of real participants, as ``tests/ros2/record.py`` has recorded them."""

from pathlib import Path

import msgspec

FOLDER = Path(__file__).parent / "recordings"
VENDORS = "cyclone", "jazzy", "kilted"
"""Whose they are: Cyclone DDS, Fast DDS 2.14 and 3.2."""
PUBLISHER = "172.30.1.11"
SUBSCRIBER = "172.30.1.12"


class Datagram(msgspec.Struct, frozen=True):
    """A datagram, where it came from and where it went, each as ``host:port``; it is in hex."""

    source: str
    target: str
    payload: str

    @property
    def host(self) -> str:
        """The address that it came from."""
        return self.source.partition(":")[0]

    @property
    def content(self) -> bytes:
        """The message."""
        return bytes.fromhex(self.payload)


def recorded(vendor: str) -> list[Datagram]:
    """What was recorded of an implementation, in the order in which it was sent."""
    lines = (FOLDER / f"{vendor}.jsonl").read_bytes()
    return msgspec.json.Decoder(Datagram).decode_lines(lines)
