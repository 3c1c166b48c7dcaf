"""A master or node to which no way leads: it is not told as gone, or as another program."""

import errno
from typing import NoReturn

import pytest

from rosproxy.doctor.facts import DoctorFacts, ReachOutcome
from rosproxy.doctor.graph_survey import ask_graph
from rosproxy.net import http_client
from rosproxy.shared.addresses import HostPort

MASTER = "http://192.0.2.7:11311"


@pytest.mark.parametrize(
    ("number", "reach", "reason"),
    [
        (errno.EHOSTUNREACH, ReachOutcome.SILENT, "no route to host"),
        (errno.ENETUNREACH, ReachOutcome.SILENT, "network is unreachable"),
        (errno.ETIMEDOUT, ReachOutcome.SILENT, "no answer in time"),
        (errno.ECONNREFUSED, ReachOutcome.REFUSED, ""),
        (errno.ECONNRESET, ReachOutcome.STRANGER, "connection reset by peer"),
    ],
)
async def test_how_a_connection_to_the_master_fails(
    monkeypatch: pytest.MonkeyPatch, number: int, reach: ReachOutcome, reason: str
) -> None:
    async def dial(peer: HostPort, timeout: float) -> NoReturn:
        raise OSError(number, "failed")

    monkeypatch.setattr(http_client, "dial", dial)
    facts = await ask_graph(DoctorFacts(), MASTER, None, None)
    assert facts.master is not None
    assert (facts.master.attempt.reach, facts.master.attempt.reason) == (reach, reason)
