"""Whether outside can reach a proxy as it was set up."""

import pytest

from rosproxy.admin.doctor_finding import Severity
from rosproxy.admin.requests import PortProbe, RangeProbe
from rosproxy.admin.setup_rules import advertised_host, few_ports, published_range
from rosproxy.admin.status_document import PortsStatus


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


def test_udp_that_does_not_come_back_proves_little() -> None:
    ports = PortsStatus("11400-11431", "12400-12431")
    for outcome, severity in (("ok", Severity.OK), ("silent", Severity.INFO)):
        probe = RangeProbe((PortProbe(11400, "host:12400", outcome, "unknown", "udp"),))
        (finding,) = published_range(probe, "host", ports)
        assert finding.severity is severity
    assert "12400-12431:11400-11431/udp" in finding.fix


def test_another_proxy_on_the_range_is_named() -> None:
    ports = PortsStatus("1-9", "1-9", free=5, blocked=4, held_by=("another rosproxy (x)",))
    told = next(iter(few_ports(ports)))
    assert "held by other programs: another rosproxy (x)" in told.text
    assert "another --port-range" in told.fix
