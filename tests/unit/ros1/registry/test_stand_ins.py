"""Second ports of stand-ins for nodes outside."""

from itertools import count

from rosproxy.ros1.registry.stand_ins import MOST_TRIES, StandIn, StandIns
from rosproxy.shared.addresses import HostPort
from tests.unit.builders import make_stand_ins

NEAR = "172.30.1.2"


def make_stand_in(number: int) -> StandIn:
    address = HostPort("robot", number)
    return StandIn(
        HostPort(NEAR, 20_000 + number), f"http://{address}/", address, is_uri_kept=False
    )


def open_fast_port(stand_ins: StandIns, stand_in: StandIn) -> HostPort:
    candidate = stand_ins.choose_fast_candidate(stand_in)
    assert candidate is not None
    stand_ins.note_fast_port(stand_in, candidate.port)
    return candidate


def test_stand_ins_with_the_same_computed_port_get_a_port_each() -> None:
    """With a hundred nodes outside, two URIs give the same port with a probability of a half."""
    stand_ins = make_stand_ins(direction="both")
    first = make_stand_in(1)
    second = next(
        stand_in for stand_in in map(make_stand_in, count(2)) if stand_in.port == first.port
    )

    ports = [open_fast_port(stand_ins, stand_in).port for stand_in in (first, second)]

    assert ports == [stand_in.port for stand_in in (first, second)]
    assert ports[0] != ports[1]
    assert stand_ins.choose_fast_candidate(second) is None
    assert stand_ins.by_port == dict(zip(ports, (first, second), strict=True))


def test_who_finds_all_taken_has_none() -> None:
    stand_ins = make_stand_ins(direction="both")
    stand_in = make_stand_in(1)
    for stand_in.fast_attempts in range(MOST_TRIES):
        stand_ins.by_port[stand_in.port] = make_stand_in(2)
    assert stand_ins.choose_fast_candidate(stand_in) is None


def test_a_service_has_none() -> None:
    address = HostPort("robot", 4000)
    stand_in = StandIn(HostPort(NEAR, 20_000), f"rosrpc://{address}", address, is_uri_kept=False)
    assert make_stand_ins(direction="both").choose_fast_candidate(stand_in) is None
