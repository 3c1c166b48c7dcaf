"""The proof between the proxy and the LAN relay: accepted and refused datagrams."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros2.protocol import relay_proof
from rosproxy.ros2.protocol.relay_proof import (
    LONGEST_CONTENT_BYTES,
    MAGIC,
    WINDOW_S,
    Direction,
    ProofError,
    RelayProof,
)

SECRET = "0123456789abcdef"
SENT_AT = 1_795_698_000.25
CONTENT = b"RTPS and the rest"
HEADER = len(MAGIC) + 8 + 16


def at(seconds: float, secret: str = SECRET) -> RelayProof:
    """A program that has a secret, at a time."""
    return RelayProof(secret, lambda: seconds)


SEALED = at(SENT_AT).sealed(Direction.TO_PROXY, CONTENT)


def opened(datagram: bytes, later: float = 0.0, secret: str = SECRET) -> bytes:
    return at(SENT_AT + later, secret).opened(Direction.TO_PROXY, datagram)


@given(st.binary(max_size=200), st.sampled_from(Direction))
def test_the_other_program_reads_what_was_sent(content: bytes, direction: Direction) -> None:
    sealed = at(SENT_AT).sealed(direction, content)
    assert at(SENT_AT).opened(direction, sealed) == content
    assert len(sealed) == HEADER + len(content)


@pytest.mark.parametrize("later", [-WINDOW_S, 0.0, WINDOW_S])
def test_clocks_may_differ_by_the_window(later: float) -> None:
    assert opened(SEALED, later) == CONTENT


@pytest.mark.parametrize("later", [-WINDOW_S - 1, WINDOW_S + 1, 86400.0])
def test_a_repeated_datagram_is_refused_after_the_window(later: float) -> None:
    with pytest.raises(ProofError, match="was repeated, or the clocks"):
        opened(SEALED, later)


@pytest.mark.parametrize("position", [4, 11, 12, 27, 28, len(SEALED) - 1])
def test_nothing_in_it_can_be_changed(position: int) -> None:
    """Neither the time stamp, nor the proof, nor the claimed address, nor the announcement."""
    changed = bytearray(SEALED)
    changed[position] ^= 1
    with pytest.raises(ProofError, match="the proof is wrong"):
        opened(bytes(changed))


@pytest.mark.parametrize("length", range(HEADER))
def test_a_truncated_proof_is_refused(length: int) -> None:
    with pytest.raises(ProofError, match="the datagram has no proof"):
        opened(SEALED[:length])


def test_a_truncated_content_is_refused() -> None:
    with pytest.raises(ProofError, match="the proof is wrong"):
        opened(SEALED[:-1])


def test_another_secret_is_refused() -> None:
    with pytest.raises(ProofError, match=r"the proof is wrong\. Give the proxy and its LAN relay"):
        opened(SEALED, secret="0123456789abcdeg")


def test_a_datagram_of_the_proxy_is_not_accepted_from_the_relay() -> None:
    """A receiver could send the datagram back to the proxy."""
    sent = at(SENT_AT).sealed(Direction.TO_LAN, CONTENT)
    with pytest.raises(ProofError, match="the proof is wrong"):
        opened(sent)


def test_a_long_datagram_costs_no_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any process may send 64 KiB, which take 60 us each."""
    longest = at(SENT_AT).sealed(Direction.TO_PROXY, bytes(LONGEST_CONTENT_BYTES))
    assert len(opened(longest)) == LONGEST_CONTENT_BYTES
    receiver = at(SENT_AT)
    monkeypatch.setattr(relay_proof, "blake2b", None)
    with pytest.raises(ProofError, match="more than 8208 bytes"):
        receiver.opened(Direction.TO_PROXY, longest + b"1")
