"""The doctor's reading of a participant's answer."""

import errno
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.doctor import domain_survey
from rosproxy.doctor.domain_survey import (
    MOST_AT_ADDRESS,
    ask_participants,
    heard_participant,
)
from rosproxy.doctor.facts import HeardParticipant
from rosproxy.ros2.protocol.announcement import dispose_message
from rosproxy.ros2.protocol.locators import pack_locator
from rosproxy.ros2.protocol.parameters import Pid
from rosproxy.shared.addresses import HostPort
from tests.unit.ros2.protocol.messages import PREFIX, data, message, payload

SOURCE = "172.30.0.5"
NAME = "00.01.02.03.04.05.06.07.08.09.0a.0b"


def answer(port: int, domain: int | None = None) -> bytes:
    parameters = [(Pid.METATRAFFIC_UNICAST_LOCATOR, pack_locator(HostPort(SOURCE, port), "<"))]
    parameters += [] if domain is None else [(Pid.DOMAIN_ID, struct.pack("<I", domain))]
    return message(data(payload(parameters)))


@pytest.mark.parametrize(
    ("port", "said", "domain"),
    [(7410, None, 0), (7412, 0, 0), (8660, None, 5), (58_793, 3, 3), (65_410, None, 232)],
)
def test_of_which_domain_it_is(port: int, said: int | None, domain: int) -> None:
    participant = heard_participant(answer(port, said), SOURCE)
    assert participant == HeardParticipant(domain, NAME, SOURCE, "Fast DDS")


@pytest.mark.parametrize(
    "datagram",
    [answer(1024), dispose_message(PREFIX), message(), b"", b"RTPS"],
    ids=["port", "end", "nothing", "empty", "cut"],
)
def test_what_says_nothing(datagram: bytes) -> None:
    assert heard_participant(datagram, SOURCE) is None


@given(st.binary(max_size=200))
def test_whatever_is_answered(rest: bytes) -> None:
    heard_participant(answer(7410)[:60] + rest, SOURCE)


@pytest.mark.parametrize("network", ["somewhere", "fd00::/64", "192.0.2.0/24", "10.0.0.0/99"])
def test_a_network_that_this_machine_is_not_in_is_not_asked(network: str) -> None:
    assert ask_participants(network, [0]) == []


class FailingSocket:
    """A socket with a single answer. The network is gone after the answer."""

    def __init__(self, receives: bool) -> None:
        self._receives = receives
        self._answers = [answer(7410)]
        self._has_answered = False

    def sendto(self, _: bytes, __: tuple[str, int]) -> None:
        if self._has_answered:
            raise OSError(errno.ENETUNREACH, "Network is unreachable")

    def recvfrom(self, _: int) -> tuple[bytes, tuple[str, int]]:
        if self._answers:
            self._has_answered = True
            return self._answers.pop(), (SOURCE, 7410)
        if self._receives:
            raise TimeoutError
        raise OSError(errno.ENETDOWN, "Network is down")

    def getsockname(self) -> tuple[str, int]:
        return "127.0.0.1", 50_000

    def settimeout(self, _: float | None) -> None:
        """Ignore the time-out."""

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize("receives", [True, False])
def test_answers_count_if_the_network_is_gone_afterwards(
    monkeypatch: pytest.MonkeyPatch, receives: bool
) -> None:
    monkeypatch.setattr(domain_survey, "send_through", lambda *_, **__: None)
    monkeypatch.setattr("rosproxy.forwarding.datagrams.bind", lambda *_: FailingSocket(receives))
    (participant,) = ask_participants("127.0.0.0/8", [0])
    assert participant.guid_prefix == NAME


def test_an_address_with_many_participants_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    crowd = [HeardParticipant(0, f"evil{n}", "172.30.0.66", "unknown") for n in range(1000)]
    quiet = HeardParticipant(0, NAME, SOURCE, "Fast DDS")
    monkeypatch.setattr(domain_survey, "_answers", lambda _: [*crowd, crowd[0], quiet])
    monkeypatch.setattr(domain_survey, "send_through", lambda *_, **__: None)
    monkeypatch.setattr("rosproxy.forwarding.datagrams.bind", lambda *_: FailingSocket(True))
    assert ask_participants("127.0.0.0/8", [0]) == [*crowd[:MOST_AT_ADDRESS], quiet]
