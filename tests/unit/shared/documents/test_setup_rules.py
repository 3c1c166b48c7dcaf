"""Settings with which outside cannot reach the proxy."""

import shlex

import pytest

from rosproxy.shared.documents.doctor_finding import Severity
from rosproxy.shared.documents.requests import PortProbe, RangeProbe
from rosproxy.shared.documents.setup_rules import (
    advertised_host,
    free_ports,
    is_all_here,
    probe_result,
    published_range,
)
from rosproxy.shared.documents.status_document import PortsStatus


@pytest.mark.parametrize(
    ("host", "addresses", "all_here", "severity", "text"),
    [
        ("127.0.0.1", ["127.0.0.1"], False, Severity.ERROR, "is a loopback address"),
        ("localhost", ["127.0.0.1"], False, Severity.ERROR, "is a loopback address"),
        ("::1", ["::1"], False, Severity.ERROR, "is a loopback address"),
        ("robot", [], False, Severity.ERROR, "can't be resolved here"),
        ("robot", [], True, Severity.ERROR, "can't be resolved here"),
        ("robot", ["127.0.1.1"], False, Severity.WARNING, "leads to 127.0.1.1 here"),
        ("robot", ["127.0.1.1", "192.0.2.7"], False, None, ""),
        ("localhost", ["127.0.0.1"], True, None, ""),
        ("robot", ["192.0.2.7"], False, None, ""),
    ],
)
def test_where_the_advertised_host_leads(host, addresses, all_here, severity, text) -> None:
    findings = list(advertised_host(host, addresses, all_here))
    assert [finding.severity for finding in findings] == ([severity] if severity else [])
    assert all(
        text in finding.text and "--advertise-host ADDRESS" in finding.fix for finding in findings
    )


@pytest.mark.parametrize(
    ("outside", "lan_relay", "all_here"),
    [
        ([["127.0.0.1"]], False, True),
        ([["robot", "127.0.1.1"], ["::1"]], False, True),
        ([["127.0.0.1"], ["192.0.2.7"]], False, False),
        ([["127.0.0.1"]], True, False),
        ([["unresolvable"]], False, False),
        ([[]], False, False),
        ([], False, False),
        ([], True, False),
    ],
)
def test_outside_is_here_if_the_master_and_all_peers_are(outside, lan_relay, all_here) -> None:
    assert is_all_here(outside, lan_relay) == all_here


def test_udp_that_does_not_come_back_proves_little() -> None:
    ports = PortsStatus("11400-11431", "12400-12431")
    for outcome, severity in (("ok", Severity.OK), ("silent", Severity.INFO)):
        probe = RangeProbe((PortProbe(11400, "host:12400", outcome, "unknown", "udp"),))
        (finding,) = published_range(probe, "host", ports)
        assert finding.severity is severity
    assert "12400-12431:11400-11431/udp" in finding.fix


@pytest.mark.parametrize(
    ("trials", "reached", "from_proxy"),
    [
        ([("refused", "ok", "tcp")], True, "refused"),
        ([("ok", "missed", "tcp")], False, "ok"),
        ([("ok", "unknown", "tcp")], True, "ok"),
        ([("silent", "unknown", "tcp")], None, "silent"),
        ([("stranger", "unknown", "tcp")], False, "stranger"),
        ([("silent", "unknown", "udp")], None, "silent"),
        ([("ok", "unknown", "udp")], True, "ok"),
        ([("ok", "ok", "tcp"), ("refused", "missed", "tcp")], False, "refused"),
        ([("ok", "ok", "tcp"), ("silent", "unknown", "udp")], None, "silent"),
        ([("silent", "unknown", "udp"), ("refused", "missed", "tcp")], False, "refused"),
    ],
)
def test_tries_prove_what_their_findings_say(trials, reached, from_proxy) -> None:
    probe = RangeProbe(tuple(PortProbe(1, "host:1", p, m, t) for p, m, t in trials))
    result = probe_result(probe)
    assert result is not None
    assert (result.reached, result.from_proxy) == (reached, from_proxy)
    worst = max(f.severity for f in published_range(probe, "host", PortsStatus("1-9", "1-9")))
    assert (worst is Severity.OK) == (reached is True)
    assert (worst is Severity.ERROR) == (reached is False)


def test_no_try_proves_nothing() -> None:
    assert probe_result(RangeProbe()) is None


def test_another_proxy_on_the_range_is_named() -> None:
    ports = PortsStatus("1-9", "1-9", free=5, blocked=4, held_by=("another rosproxy (x)",))
    told = next(iter(free_ports(ports)))
    assert "other programs hold 4 ports of the range 1-9: another rosproxy (x)" in told.text
    assert "another --port-range" in told.fix


def test_what_a_proxy_calls_its_range_is_no_command() -> None:
    """A proxy in hostile hands ended the quote that stood in the fix, and began a command."""
    ports = PortsStatus("1' ; touch pwned #-2", "1-9", free=5, blocked=4)
    told = next(iter(free_ports(ports)))
    command = told.fix.removeprefix("find the programs: ").partition("; or set another")[0]
    assert shlex.split(command) == ["ss", "-ltnp", "sport >= :1' ; touch pwned # and sport <= :2"]
