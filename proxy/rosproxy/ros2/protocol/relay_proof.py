"""The proof that a datagram comes from the LAN relay, or from the proxy of this relay.

Both programs know the same secret. A source address proves nothing: behind Docker's port proxy, and
where Kubernetes masquerades, each client has the address of the relay.

    magic 4, time stamp 8 (milliseconds of Unix time, big-endian), proof 16, then the content

The proof is a keyed BLAKE2b (RFC 7693) of the time stamp and the content. The direction is the
*person* parameter of the hash, so a proof for one direction is wrong in the opposite direction.

A proof is valid for `WINDOW_S` seconds before and after the receiver's clock. Neither program keeps
state, so each program may restart at any time. Within the window, an attacker may repeat a
datagram. The repeated datagram tells only what a participant has just told the whole LAN. At worst,
a participant that has ended lives for another lease duration, or the proxy forgets a live
participant until the next announcement, seconds later. The relay runs on the proxy's machine, so
both programs have the same clock, also if the clock jumps.
"""

import hmac
import struct
from collections.abc import Callable
from enum import Enum
from hashlib import blake2b

from rosproxy.ros2.protocol.rtps import RtpsError

MAGIC = b"RPX1"
WINDOW_S = 30.0
"""Seconds by which the time stamp may differ from the receiver's clock."""
LONGEST_CONTENT_BYTES = 8192 + 16
"""The most bytes of a content that the receiver reads: the longest announcement, and an address."""
_PROOF_SIZE = 16
_STAMP = struct.Struct(">Q")
_CONTENT_AT = len(MAGIC) + _STAMP.size + _PROOF_SIZE


class ProofError(RtpsError):
    """A datagram without a valid proof."""


class Direction(Enum):
    """The direction of a datagram. A value has at most 16 bytes (RFC 7693, 2.8)."""

    TO_PROXY = b"LAN to proxy"
    TO_LAN = b"proxy to LAN"


class RelayProof:
    """Adds proofs to contents, and checks proofs. ``unix_time`` is the wall clock, in seconds."""

    __slots__ = ("_key", "_unix_time")

    def __init__(self, secret: str, unix_time: Callable[[], float]) -> None:
        self._key = blake2b(secret.encode(), digest_size=32).digest()
        self._unix_time = unix_time

    def sealed(self, direction: Direction, content: bytes) -> bytes:
        """Return the datagram with a content and the proof."""
        stamp = _STAMP.pack(int(self._unix_time() * 1000))
        return MAGIC + stamp + self._proof(direction, stamp, content) + content

    def opened(self, direction: Direction, datagram: bytes) -> bytes:
        """Return the content of a datagram. Raises ProofError if the proof is not valid."""
        if not datagram.startswith(MAGIC) or len(datagram) < _CONTENT_AT:
            raise ProofError(
                "the datagram has no proof. Use the same version for the proxy and its LAN relay"
            )
        if len(datagram) > _CONTENT_AT + LONGEST_CONTENT_BYTES:
            raise ProofError(
                f"the datagram has more than {LONGEST_CONTENT_BYTES} bytes after its proof"
            )
        stamp = datagram[len(MAGIC) : len(MAGIC) + _STAMP.size]
        proof = datagram[len(MAGIC) + _STAMP.size : _CONTENT_AT]
        content = datagram[_CONTENT_AT:]
        if not hmac.compare_digest(proof, self._proof(direction, stamp, content)):
            text = "the proof is wrong. Give the proxy and its LAN relay the same secret"
            raise ProofError(text)
        age = self._unix_time() - _STAMP.unpack(stamp)[0] / 1000
        if abs(age) > WINDOW_S:
            text = "the datagram was repeated, or the clocks of the proxy and its LAN relay differ"
            raise ProofError(f"the proof is {age:.0f} s old: {text}")
        return content

    def _proof(self, direction: Direction, stamp: bytes, content: bytes) -> bytes:
        proof = blake2b(stamp, digest_size=_PROOF_SIZE, key=self._key, person=direction.value)
        proof.update(content)
        return proof.digest()
