"""The text that outlasts the proxy: the node of each lease, and the node's location."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosproxy.ros1.registry import remembered_leases
from rosproxy.ros1.registry.endpoint import MOST_SERVICE_PORTS
from rosproxy.ros1.registry.remembered_leases import (
    LeasesAtMaster,
    RememberedLease,
    parameter_of,
    read_leases,
)
from rosproxy.shared.addresses import HostPort
from rosproxy.shared.ports import PortMap, PortRange
from rosproxy.shared.uris import InsidePath, parse_inside_path
from tests.unit.builders import add_node, make_addressing

PORTS = PortMap(PortRange(45000, 45009), PortRange(30000, 30009))
PLACE = InsidePath(HostPort("10.0.0.5", 40001))


def test_each_proxy_has_a_parameter_of_its_own() -> None:
    names = {parameter_of(host, PORTS) for host in ("10.77.0.1", "robot", "fd00::1")}
    names.add(parameter_of("robot", PortMap(PortRange(45000, 45009), PortRange(45000, 45009))))
    assert names == {
        "/rosproxy/leases_10_77_0_1_30000",
        "/rosproxy/leases_robot_30000",
        "/rosproxy/leases_fd00__1_30000",
        "/rosproxy/leases_robot_45000",
    }


def test_a_lease_is_a_line() -> None:
    addressing = make_addressing()
    first = add_node(addressing, "http://10.0.0.5:40001/")
    add_node(addressing, "http://c6:40001/", "10.0.0.6")
    for port in (41234, 41235):
        first.note_service_port(port)
    text = remembered_leases.leases_text(addressing.registry, addressing.ports)
    assert text == "45000 /10.0.0.5:40001/ 41234 41235\n45001 /c6:40001/10.0.0.6/\n"
    leases = read_leases(text, addressing.ports)
    assert leases == {
        45000: RememberedLease(PLACE, (41234, 41235)),
        45001: RememberedLease(InsidePath(HostPort("c6", 40001), "10.0.0.6")),
    }


def test_the_ports_are_those_that_outside_sees() -> None:
    assert read_leases("30003 /10.0.0.5:40001/\n", PORTS) == {45003: RememberedLease(PLACE)}
    assert read_leases("45003 /10.0.0.5:40001/\n", PORTS) == {}


def test_so_many_ports_of_services_are_kept_the_newest() -> None:
    addressing = make_addressing()
    endpoint = add_node(addressing)
    update = [endpoint.note_service_port(port) for port in range(1, 40)]
    assert all(update)
    assert not endpoint.note_service_port(39)
    text = remembered_leases.leases_text([endpoint], addressing.ports)
    (lease,) = read_leases(text, addressing.ports).values()
    assert lease.service_ports == tuple(range(40 - MOST_SERVICE_PORTS, 40))


def test_what_any_proxy_has_at_an_address_is_told() -> None:
    parameters = {
        "leases_robot_30000": "30003 /10.0.0.5:40001/\n",
        "leases_robot_45000": "x",
        "y": 1,
    }
    assert LeasesAtMaster(parameters).at(HostPort("robot", 30003)) == RememberedLease(PLACE)
    assert LeasesAtMaster(parameters).at(HostPort("robot", 30004)) is None
    assert LeasesAtMaster(parameters).at(HostPort("laptop", 30003)) is None
    assert LeasesAtMaster("nothing").at(HostPort("robot", 30003)) is None


def test_a_host_whose_name_begins_alike_has_other_leases() -> None:
    parameters = {"leases_robot_lan_30000": "30003 /10.0.0.9:40001/\n"}
    assert LeasesAtMaster(parameters).at(HostPort("robot", 30003)) is None
    assert LeasesAtMaster(parameters).at(HostPort("robot.lan", 30003)) is not None
    parameters["leases_robot_30000"] = "30003 /10.0.0.5:40001/\n"
    assert LeasesAtMaster(parameters).at(HostPort("robot", 30003)) == RememberedLease(PLACE)


@given(st.text() | st.integers() | st.lists(st.text()) | st.dictionaries(st.text(), st.text()))
def test_nothing_that_somebody_writes_there_is_an_error(value: object) -> None:
    read_leases(value, PORTS)
    LeasesAtMaster(value).at(HostPort("robot", 30003))


LINES = st.builds(
    "{} {}{}".format,
    st.integers(0, 99_999),
    st.sampled_from(["/10.0.0.5:40001/", "/c:1/fd00::1/", "/c:1/d/", "/", "//", "/x/", "/%zz:1/"]),
    st.sampled_from(["", " 1", " 0 99999 1", " x", " 1 " * 50]),
)


@given(st.lists(LINES).map("\n".join))
def test_what_is_read_is_lawful(text: str) -> None:
    for port, lease in read_leases(text, PORTS).items():
        assert port in PORTS.listen
        assert len(lease.service_ports) <= MOST_SERVICE_PORTS
        assert all(0 < service < 65536 for service in lease.service_ports)


def test_each_line_is_read_once_for_all_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For each node, the doctor read all lines of a parameter that any program can set."""
    monkeypatch.setattr(remembered_leases, "MOST_LINES", 100)
    read = list[str]()

    def parse(uri: str) -> InsidePath | None:
        read.append(uri)
        return parse_inside_path(uri)

    monkeypatch.setattr(remembered_leases, "parse_inside_path", parse)
    lines = "".join(f"{30_000 + number} /10.0.0.5:1/\n" for number in range(1000))
    leases = LeasesAtMaster({"leases_robot_30000": lines, "leases_robot_40000": lines})
    found = [leases.at(HostPort("robot", 30_000 + number)) is not None for number in range(200)]
    assert found == [True] * 100 + [False] * 100
    assert len(read) == 100
