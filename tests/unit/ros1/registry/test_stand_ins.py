"""Stand-ins for nodes outside: their second ports."""

from itertools import count

from rosproxy.net.addresses import HostPort
from rosproxy.ros1.registry.stand_ins import TRIES, StandIn, StandIns
from tests.unit.builders import make_stand_ins

NEAR = "172.30.1.2"


def stand_in(number: int) -> StandIn:
    where = HostPort("robot", number)
    return StandIn(HostPort(NEAR, 20_000 + number), f"http://{where}/", where, is_uri_kept=False)


def opened(all_of: StandIns, one: StandIn) -> HostPort:
    there = all_of.choose_fast_candidate(one)
    assert there is not None
    all_of.note_fast_port(one, there.port)
    return there


def test_two_whose_ports_would_be_the_same_get_one_each() -> None:
    """Their URIs give the same number; of a hundred nodes outside, two do in one case of two."""
    all_of, first = make_stand_ins(direction="both"), stand_in(1)
    second = next(one for one in map(stand_in, count(2)) if one.port == first.port)

    ports = [opened(all_of, one).port for one in (first, second)]

    assert ports == [one.port for one in (first, second)]
    assert ports[0] != ports[1]
    assert all_of.choose_fast_candidate(second) is None
    assert all_of.by_port == dict(zip(ports, (first, second), strict=True))


def test_who_finds_all_taken_has_none() -> None:
    all_of, one = make_stand_ins(direction="both"), stand_in(1)
    for one.fast_attempts in range(TRIES):
        all_of.by_port[one.port] = stand_in(2)
    assert all_of.choose_fast_candidate(one) is None


def test_a_service_has_none() -> None:
    where = HostPort("robot", 4000)
    one = StandIn(HostPort(NEAR, 20_000), f"rosrpc://{where}", where, is_uri_kept=False)
    assert make_stand_ins(direction="both").choose_fast_candidate(one) is None
