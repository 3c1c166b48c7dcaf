"""A domain under whatever may come, in any order: what has to hold after each datagram.

Hypothesis plays neighbours on both sides that share prefixes, addresses and ports, forge sources,
and damage datagrams; policy and time change meanwhile. It is short in `make check`. To have it look
for long, run ``pytest --hypothesis-profile=thorough`` with this file.
"""

import struct
from collections import Counter

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rosproxy.access.rules import RuleKind
from rosproxy.ros2.discovery import fragments
from rosproxy.ros2.discovery.domain_settings import MOST_LEASES, Outgoing
from rosproxy.ros2.discovery.rates import BURST, MOST_SOURCES
from rosproxy.ros2.protocol.envelope import wrapped
from rosproxy.ros2.protocol.rtps import LAST_NUMBER
from rosproxy.ros2.registry.locator_ports import MOST_SHARING, STAND_INS
from tests.unit.ros2.discovery.domains import (
    EAR,
    INSIDE,
    NOW,
    OTHER,
    ROBOT,
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    domain,
    farewell,
    sedp,
    spdp,
)
from tests.unit.ros2.protocol.messages import data, fragment, message, payload, submessage

PREFIXES = [A, B, bytes([9]) * 12]
NEAR_BY, FAR = [INSIDE, OTHER], [ROBOT, STRANGER]
PREFIX, ADDRESS = st.sampled_from(PREFIXES), st.sampled_from(NEAR_BY + FAR)
PORT = st.integers(7410, 7440)
OWN = bytes([5]) * 12
MEANT = st.sampled_from([OWN, *PREFIXES])
TOLD_BEHIND = st.builds(sedp, PREFIX, ADDRESS, PORT)
DESCRIBED = payload([(5, b"\x0b\0\0\0rt/chatter\0\0"), (0x8000, bytes(300))])
NUMBER = st.sampled_from([-(2**63), -1, 0, 1, 2, 3, LAST_NUMBER, LAST_NUMBER + 1])


def pack(number: int) -> bytes:
    return struct.pack("<II", number >> 32 & 0xFFFFFFFF, number & 0xFFFFFFFF)


def heartbeat(prefix: bytes, meant: bytes, number: int) -> bytes:
    body = bytes(4) + SEDP_WRITERS.to_bytes(4, "big") + 2 * pack(number) + bytes(4)
    return message(submessage(0x0E, 0, meant), submessage(0x07, 0, body), prefix=prefix)


def fragmented(prefix: bytes, number: int, sequence: int, size: int) -> bytes:
    part = DESCRIBED[(number - 1) * size : number * size]
    cut = fragment(part, number, size, len(DESCRIBED), writer=SEDP_WRITERS, sequence=sequence)
    return message(cut, prefix=prefix)


def told(prefix: bytes, sequence: int) -> bytes:
    return message(data(DESCRIBED, writer=SEDP_WRITERS, sequence=sequence), prefix=prefix)


SAID = st.one_of(
    st.builds(spdp, PREFIX, ADDRESS, PORT, st.sampled_from([-1, 2, 20])),
    st.builds(spdp, PREFIX, ADDRESS),
    st.builds(farewell, PREFIX),
    st.builds(sedp, PREFIX, ADDRESS, PORT, MEANT),
    st.builds(lambda one, other: one + other[20:], st.builds(spdp, PREFIX, ADDRESS), TOLD_BEHIND),
    st.builds(heartbeat, PREFIX, MEANT, NUMBER),
    st.builds(fragmented, PREFIX, st.integers(1, 4), NUMBER, st.sampled_from([100, 128, 300])),
    st.builds(told, PREFIX, NUMBER),
)
"""What participants say, true or not."""


@st.composite
def datagrams(draw: st.DrawFn) -> bytes:
    """The same, damaged now and then."""
    found = bytearray(draw(SAID))
    for _ in range(draw(st.sampled_from([0, 0, 0, 1, 3]))):
        found[draw(st.integers(0, len(found) - 1))] = draw(st.integers(0, 255))
    return bytes(found[: draw(st.sampled_from([len(found)] * 4 + [len(found) // 2]))])


class Neighbours(RuleBasedStateMachine):
    """Whoever sends something to a domain."""

    def __init__(self) -> None:
        super().__init__()
        self.denied = set[RuleKind]()
        self.one = domain(
            peers=(ROBOT,), judge=lambda kind, *_: kind not in self.denied, both_ways=True
        )
        self.one.own.observer.prefix = OWN
        self.now = 0.0
        self.came, self.went = Counter[str](), Counter[str]()
        self.proven = {ROBOT}

    @initialize(started=st.sampled_from([0.0, NOW]))
    def some_are_there(self, started: float) -> None:
        self.now = started

    @rule(datagram=datagrams(), source=st.sampled_from(NEAR_BY))
    def inside_announces(self, datagram: bytes, source: str) -> None:
        self.check(self.one.heard_inside(datagram, source, self.now))

    @rule(datagram=datagrams(), source=ADDRESS)
    def outside_announces(self, datagram: bytes, source: str) -> None:
        self.came[source] += len(datagram)
        self.check(self.one.heard_outside(datagram, source, self.now))

    @rule(datagram=datagrams(), source=ADDRESS)
    def the_ear_tells(self, datagram: bytes, source: str) -> None:
        self.came[source] += len(datagram)
        self.check(self.one.heard_outside(wrapped(source, datagram), EAR.host, self.now))

    @rule(datagram=datagrams(), source=ADDRESS, port=st.integers(45001, 45015))
    def a_port_gets_something(self, datagram: bytes, source: str, port: int) -> None:
        leased = self.one.inside.leases.get(port)
        self.came[source] += len(datagram)
        sent = self.one.at_lease(port, datagram, source, self.now)
        where = leased[1].target if leased else None
        assert {out.target for out in sent} <= {where}
        assert not leased or len(sent) <= 1 or leased[0].prefix in self.one.inside.by_prefix

    @rule(datagram=datagrams(), source=ADDRESS, index=st.integers(0, 9))
    def a_stand_in_gets_something(self, datagram: bytes, source: str, index: int) -> None:
        ports = sorted(self.one.outside.stand_ins) or [STAND_INS.first]
        sent = self.one.at_stand_in(ports[index % len(ports)], datagram, source, self.now)
        assert not sent or source in self.one.inside.count_by_address
        self.check(sent)

    @rule(prefix=PREFIX, address=ADDRESS)
    def somebody_announces_himself(self, prefix: bytes, address: str) -> None:
        if address in NEAR_BY:
            self.inside_announces(spdp(prefix, address), address)
        else:
            self.the_ear_tells(spdp(prefix, address), address)

    @rule(address=st.sampled_from(NEAR_BY), port=PORT)
    def somebody_speaks_to_all_outside(self, address: str, port: int) -> None:
        own = [one for one in self.one.inside.by_prefix.values() if one.address == address]
        for one in own:
            for stand_in in 8 * list(self.one.outside.stand_ins):
                said = sedp(one.prefix, address, port)
                self.check(self.one.at_stand_in(stand_in, said, address, self.now))

    @rule(seconds=st.sampled_from([0.3, 2.0, 5.0]))
    def time_passes(self, seconds: float) -> None:
        self.now += seconds
        self.check(self.one.settle(self.now))
        self.one.expire(self.now)

    @rule(denied=st.sets(st.sampled_from(RuleKind)))
    def the_policy_changes(self, denied: set[RuleKind]) -> None:
        self.denied = denied
        self.check(self.one.apply_policy(self.now))

    @rule()
    def the_proxy_observes(self) -> None:
        self.check(self.one.own.port_reminders() + self.one.own.announced_outside())

    @rule(port=st.integers(STAND_INS.first, STAND_INS.last), for_good=st.booleans())
    def another_program_has_a_port(self, port: int, for_good: bool) -> None:
        ports = sorted(self.one.outside.stand_ins)
        self.one.outside.block(ports[0] if ports and port % 8 == 0 else port, for_good)

    def check(self, sent: list[Outgoing]) -> None:
        """Hold to whom something may go: no bytes to outside that did not come from there."""
        self.proven |= {
            there.address for there in self.one.outside.by_prefix.values() if there.proven
        }
        for out in sent:
            assert 0 < out.target.port < 65536
            if out.target == EAR or out.target.host in self.proven:
                continue
            if (
                out.target.host not in NEAR_BY
                or out.target.host not in self.one.inside.count_by_address
            ):
                self.went[out.target.host] += len(out.datagram)
        waiting = {source for source, *_ in self.one.returning.waiting.values()}
        for host, size in self.went.items():
            assert host in waiting | set(NEAR_BY) or size <= self.came[host]

    @invariant()
    def leases_are_of_those_inside(self) -> None:
        inside, pool = self.one.inside, self.one.ports.pool
        assert pool.free + len(inside.leases) + 1 == len(pool.range)
        held = [lease for one in inside.by_prefix.values() for lease in one.leases.values()]
        assert len(held) == len(inside.leases)
        for port, (one, lease) in inside.leases.items():
            assert inside.by_prefix[one.prefix] is one
            assert one.leases[lease.target] is lease
            assert (lease.port, lease.target.host) == (port, one.address)
            assert not pool.is_free(port)
        assert inside.count_by_address == Counter(one.address for one in inside.by_prefix.values())
        assert inside.port_shortages.keys() <= inside.by_prefix.keys()

    @invariant()
    def stand_ins_are_of_those_outside(self) -> None:
        outside = self.one.outside
        for port, users in outside.stand_ins.items():
            assert port not in outside.blocked
            assert 0 < len(users) <= MOST_SHARING
            for there, lease in users:
                assert outside.by_prefix[there.prefix] is there
                assert there.leases[lease.target] is lease
                assert (lease.port, lease.target.host) == (port, there.address)
        held = sum(len(there.leases) for there in outside.by_prefix.values())
        assert held == sum(map(len, outside.stand_ins.values()))
        assert outside.count_by_address == Counter(
            one.address for one in outside.by_prefix.values()
        )
        assert not outside.by_prefix.keys() & self.one.inside.by_prefix.keys()

    @invariant()
    def what_is_kept_is_somebodys_and_bounded(self) -> None:
        one = self.one
        known = one.inside.by_prefix.keys() | one.outside.by_prefix.keys()
        for side in (one.inside, one.outside):
            everybody = side.by_prefix.values()
            assert all(len(there.leases) <= MOST_LEASES for there in everybody)
            assert side.notes.total == sum(len(there.endpoints) for there in everybody)
            assert side.notes.total == side.notes.count_by_address.total()
        assert {prefix for prefix, _ in one.own.observer._received} <= known
        assert one.own.keeper.number_by_prefix.keys() <= known | one.returning.waiting.keys()
        assert one.fragments.by_prefix.keys() <= known
        sizes = [store.size for store in one.fragments.by_prefix.values()]
        assert one.fragments.size == sum(sizes) <= fragments.MOST_OF_ALL
        assert len(one.rates._remaining) <= MOST_SOURCES
        assert all(left <= BURST for left, _ in one.rates._remaining.values())


TestNeighbours = Neighbours.TestCase
TestNeighbours.settings = settings(max_examples=5 * settings().max_examples)
