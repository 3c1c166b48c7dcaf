"""A domain under any datagrams in any order: invariants after each datagram.

Hypothesis plays neighbours on both sides that share prefixes, addresses and ports, forge sources,
and damage datagrams; policy and time change meanwhile. `make check` runs this test for a short
time. For a long run, use ``pytest --hypothesis-profile=thorough`` with this file.
"""

import struct
from collections import Counter

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rosproxy.ros2.discovery import fragments
from rosproxy.ros2.domain_settings import MOST_MAPPINGS, Outgoing
from rosproxy.ros2.ports.stand_ins import MOST_SHARING
from rosproxy.ros2.protocol.rtps import LAST_SEQUENCE_NUMBER, source_prefix
from rosproxy.ros2.registry.participants import ANSWERED_FACTOR
from rosproxy.ros2.sources.rates import BURST, MOST_SOURCES
from rosproxy.shared.policy.rules import RuleKind
from rosproxy.shared.ports import STAND_IN_PORTS
from tests.unit.ros2.discovery.domains import (
    INSIDE,
    LAN_RELAY,
    NOW,
    OTHER,
    ROBOT,
    SEDP_WRITERS,
    STRANGER,
    A,
    B,
    carried,
    dispose_message,
    kept_answer,
    make_domain,
    proof_answer,
    sedp,
    settle,
    spdp,
)
from tests.unit.ros2.protocol.messages import data, fragment, message, payload, submessage

PREFIXES = [A, B, bytes([9]) * 12]
NEAR_BY = [INSIDE, OTHER]
FAR = [ROBOT, STRANGER]
PREFIX_BYTES = st.sampled_from(PREFIXES)
ADDRESS = st.sampled_from(NEAR_BY + FAR)
PORT = st.integers(7410, 7440)
OWN = bytes([5]) * 12
MEANT = st.sampled_from([OWN, *PREFIXES])
TOLD_BEHIND = st.builds(sedp, PREFIX_BYTES, ADDRESS, PORT)
DESCRIBED = payload([(5, b"\x0b\0\0\0rt/chatter\0\0"), (0x8000, bytes(300))])
NUMBER = st.sampled_from([-(2**63), -1, 0, 1, 2, 3, LAST_SEQUENCE_NUMBER, LAST_SEQUENCE_NUMBER + 1])


def pack(number: int) -> bytes:
    return struct.pack("<II", number >> 32 & 0xFFFFFFFF, number & 0xFFFFFFFF)


def heartbeat(prefix: bytes, meant: bytes, number: int) -> bytes:
    body = bytes(4) + SEDP_WRITERS.to_bytes(4, "big") + 2 * pack(number) + bytes(4)
    return message(submessage(0x0E, 0, meant), submessage(0x07, 0, body), prefix=prefix)


def fragmented(prefix: bytes, number: int, sequence: int, size: int) -> bytes:
    chunk = DESCRIBED[(number - 1) * size : number * size]
    data_frag = fragment(
        chunk, number, size, len(DESCRIBED), writer=SEDP_WRITERS, sequence=sequence
    )
    return message(data_frag, prefix=prefix)


def told(prefix: bytes, sequence: int) -> bytes:
    return message(data(DESCRIBED, writer=SEDP_WRITERS, sequence=sequence), prefix=prefix)


SAID = st.one_of(
    st.builds(spdp, PREFIX_BYTES, ADDRESS, PORT, st.sampled_from([-1, 2, 20])),
    st.builds(spdp, PREFIX_BYTES, ADDRESS),
    st.builds(dispose_message, PREFIX_BYTES),
    st.builds(sedp, PREFIX_BYTES, ADDRESS, PORT, MEANT),
    st.builds(
        lambda announcement, behind: announcement + behind[20:],
        st.builds(spdp, PREFIX_BYTES, ADDRESS),
        TOLD_BEHIND,
    ),
    st.builds(heartbeat, PREFIX_BYTES, MEANT, NUMBER),
    st.builds(
        fragmented, PREFIX_BYTES, st.integers(1, 4), NUMBER, st.sampled_from([100, 128, 300])
    ),
    st.builds(told, PREFIX_BYTES, NUMBER),
)
"""Messages of participants, true or false."""


@st.composite
def datagrams(draw: st.DrawFn) -> bytes:
    """The same, damaged now and then."""
    datagram = bytearray(draw(SAID))
    for _ in range(draw(st.sampled_from([0, 0, 0, 1, 3]))):
        datagram[draw(st.integers(0, len(datagram) - 1))] = draw(st.integers(0, 255))
    return bytes(datagram[: draw(st.sampled_from([len(datagram)] * 4 + [len(datagram) // 2]))])


class Neighbours(RuleBasedStateMachine):
    """The senders around a domain."""

    def __init__(self) -> None:
        super().__init__()
        self.denied = set[RuleKind]()
        self.domain = make_domain(
            peers=(ROBOT,),
            judge=lambda kind, *_: kind not in self.denied,
            both_ways=True,
            port_store_key=b"a key",
        )
        self.domain.proxy_participants.discovery_participant.prefix = OWN
        self.now = 0.0
        self.came = Counter[str]()
        self.went = Counter[str]()
        self.proven = {ROBOT}
        self.answered = set[str]()
        self.asked = set[str]()

    @initialize(started=st.sampled_from([0.0, NOW]))
    def some_are_there(self, started: float) -> None:
        self.now = started

    @rule(datagram=datagrams(), source=st.sampled_from(NEAR_BY))
    def inside_announces(self, datagram: bytes, source: str) -> None:
        self.check(self.domain.heard_inside(datagram, source, self.now))

    @rule(datagram=datagrams(), source=ADDRESS)
    def outside_announces(self, datagram: bytes, source: str) -> None:
        self.came[source] += len(datagram)
        self.check(self.domain.heard_outside(datagram, source, self.now))

    @rule(datagram=datagrams(), source=ADDRESS)
    def the_lan_relay_tells(self, datagram: bytes, source: str) -> None:
        self.came[source] += len(datagram)
        self.check(self.domain.heard_outside(carried(source, datagram), LAN_RELAY.host, self.now))

    @rule(datagram=datagrams(), source=ADDRESS, port=st.integers(45001, 45015))
    def a_port_gets_something(self, datagram: bytes, source: str, port: int) -> None:
        mapped = self.domain.mappings.by_port.get(port)
        self.came[source] += len(datagram)
        sent = self.domain.at_range_port(port, datagram, source, self.now)
        target = mapped[1].target if mapped else None
        assert {out.target for out in sent} <= {target}
        assert not mapped or len(sent) <= 1 or mapped[0].prefix in self.domain.inside.by_prefix

    @rule(datagram=datagrams(), source=ADDRESS, index=st.integers(0, 9))
    def a_stand_in_gets_something(self, datagram: bytes, source: str, index: int) -> None:
        ports = sorted(self.domain.stand_ins.by_port) or [STAND_IN_PORTS.first]
        sent = self.domain.at_stand_in(ports[index % len(ports)], datagram, source, self.now)
        assert not sent or source in self.domain.inside.count_by_address
        self.check(sent)

    @rule(prefix=PREFIX_BYTES, address=ADDRESS)
    def somebody_announces_himself(self, prefix: bytes, address: str) -> None:
        if address in NEAR_BY:
            self.inside_announces(spdp(prefix, address), address)
        else:
            self.the_lan_relay_tells(spdp(prefix, address), address)

    @rule(prefix=PREFIX_BYTES, address=ADDRESS, is_true=st.booleans())
    def somebody_answers_a_question(self, prefix: bytes, address: str, is_true: bool) -> None:
        asked = self.domain.proofs.question(address if is_true else OTHER, prefix, [])
        named = submessage(0x0E, 0, source_prefix(asked))
        answer = message(named, submessage(0x06, 0, bytes(28)), prefix=prefix)
        if address in NEAR_BY:
            self.inside_announces(answer, address)
        else:
            self.outside_announces(answer, address)
        assert (
            is_true
            or address == OTHER
            or not self.domain.proofs.has(address)
            or (address in self.asked)
        )
        self.asked |= {address} if is_true else set()

    @rule(
        prefix=PREFIX_BYTES, address=ADDRESS, ports=st.lists(st.integers(45000, 45015), max_size=3)
    )
    def a_participant_tells_which_ports_it_had(
        self, prefix: bytes, address: str, ports: list[int]
    ) -> None:
        port_store = self.domain.proxy_participants.port_store
        answers = kept_answer(self.domain, prefix, port_store.number(ports))
        answers += proof_answer(self.domain, prefix, port_store.proof(PREFIXES[0], ports))[20:]
        if address in NEAR_BY:
            self.inside_announces(answers, address)
        else:
            self.outside_announces(answers, address)

    @rule(address=st.sampled_from(NEAR_BY), port=PORT)
    def somebody_speaks_to_all_outside(self, address: str, port: int) -> None:
        speakers = [
            participant
            for participant in self.domain.inside.by_prefix.values()
            if participant.address == address
        ]
        for participant in speakers:
            for stand_in in 8 * list(self.domain.stand_ins.by_port):
                said = sedp(participant.prefix, address, port)
                self.check(self.domain.at_stand_in(stand_in, said, address, self.now))

    @rule(seconds=st.sampled_from([0.3, 2.0, 5.0]))
    def time_passes(self, seconds: float) -> None:
        self.now += seconds
        self.check(settle(self.domain, self.now))
        self.domain.expire(self.now)

    @rule(denied=st.sets(st.sampled_from(RuleKind)))
    def the_policy_changes(self, denied: set[RuleKind]) -> None:
        self.denied = denied
        self.check(self.domain.apply_policy(self.now))

    @rule()
    def the_proxy_announces(self) -> None:
        self.check(
            [
                *self.domain.proxy_participants.port_reminders(self.now),
                *self.domain.proxy_participants.announced_outside(),
            ]
        )

    @rule(port=st.integers(STAND_IN_PORTS.first, STAND_IN_PORTS.last), for_good=st.booleans())
    def another_program_has_a_port(self, port: int, for_good: bool) -> None:
        ports = sorted(self.domain.stand_ins.by_port)
        self.domain.stand_ins.block(ports[0] if ports and port % 8 == 0 else port, for_good)

    def check(self, sent: list[Outgoing]) -> None:
        """Check all targets: an unproven outside address gets no more than came from there."""
        outsiders = self.domain.outside.by_prefix.values()
        # An address may prove to receive where no participant is known yet.
        self.proven |= {*self.domain.proofs.addresses}
        self.answered |= {outsider.address for outsider in outsiders if outsider.has_answered}
        for out in sent:
            assert 0 < out.target.port < 65536
            if out.target == LAN_RELAY or out.target.host in self.proven:
                continue
            if (
                out.target.host not in NEAR_BY
                or out.target.host not in self.domain.inside.count_by_address
            ):
                self.went[out.target.host] += len(out.datagram)
        waiting = {source for source, *_ in self.domain.former_ports.waiting.values()}
        for host, size in self.went.items():
            factor = ANSWERED_FACTOR if host in self.answered else 1
            assert host in waiting | set(NEAR_BY) or size <= factor * self.came[host]

    @invariant()
    def mappings_are_of_those_inside(self) -> None:
        inside = self.domain.inside
        pool = self.domain.ports.pool
        by_port = self.domain.mappings.by_port
        assert pool.free + len(by_port) + 1 == len(pool.range)
        mappings = [
            mapping
            for participant in inside.by_prefix.values()
            for mapping in participant.mappings.values()
        ]
        assert len(mappings) == len(by_port)
        for port, (participant, mapping) in by_port.items():
            assert inside.by_prefix[participant.prefix] is participant
            assert participant.mappings[mapping.target] is mapping
            assert (mapping.port, mapping.target.host) == (port, participant.address)
            assert not pool.is_free(port)
        by_locator = self.domain.mappings._by_locator
        assert {port: pair for at in by_locator.values() for port, pair in at.items()} == by_port
        assert all(by_locator.values())
        assert self.domain.mappings._count_by_address == Counter(
            participant.address for participant, _ in by_port.values()
        )
        assert inside.count_by_address == Counter(
            participant.address for participant in inside.by_prefix.values()
        )
        assert self.domain.mappings.shortages.keys() <= inside.by_prefix.keys()

    @invariant()
    def stand_ins_are_of_those_outside(self) -> None:
        outside = self.domain.outside
        stand_ins = self.domain.stand_ins
        for port, users in stand_ins.by_port.items():
            assert port not in stand_ins.blocked
            assert 0 < len(users) <= 2 * MOST_SHARING
            for participant, mapping in users:
                assert outside.by_prefix[participant.prefix] is participant
                assert participant.mappings[mapping.target] is mapping
                assert (mapping.port, mapping.target.host) == (port, participant.address)
        mapping_count = sum(len(participant.mappings) for participant in outside.by_prefix.values())
        assert mapping_count == sum(map(len, stand_ins.by_port.values()))
        assert outside.count_by_address == Counter(
            participant.address for participant in outside.by_prefix.values()
        )
        assert not outside.by_prefix.keys() & self.domain.inside.by_prefix.keys()

    @invariant()
    def what_is_kept_is_somebodys_and_bounded(self) -> None:
        domain = self.domain
        prefixes = domain.inside.by_prefix.keys() | domain.outside.by_prefix.keys()
        for side in (domain.inside, domain.outside):
            everybody = side.by_prefix.values()
            assert all(len(participant.mappings) <= MOST_MAPPINGS for participant in everybody)
            endpoints = [e for participant in everybody for e in participant.endpoints.values()]
            assert side.notes.size == sum(endpoint.size for endpoint in endpoints)
            assert side.notes.size == side.notes.size_by_address.total()
        verdicts = [verdict for p in domain.inside.by_prefix.values() for verdict in p.verdicts]
        assert domain.inside.verdicts.count_by_address.total() == len(verdicts)
        assert {
            prefix for prefix, _ in domain.proxy_participants.discovery_participant._received
        } <= prefixes
        known = prefixes | domain.former_ports.waiting.keys()
        assert {*domain.proxy_participants.port_store.prefixes} <= known
        assert domain.ports._ports_claimed.keys() <= known
        assert domain.fragments.by_prefix.keys() <= prefixes
        sizes = [store.size for store in domain.fragments.by_prefix.values()]
        assert domain.fragments.size == sum(sizes) <= fragments.MOST_BYTES_OF_ALL
        assert len(domain.rates._by_source) <= MOST_SOURCES
        assert all(allowance.remaining <= BURST for allowance in domain.rates._by_source.values())


TestNeighbours = Neighbours.TestCase
TestNeighbours.settings = settings(max_examples=5 * settings().max_examples)
