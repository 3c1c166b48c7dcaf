"""Learn the names of ROS 2 nodes from user data: from samples of ``ros_discovery_info``.

The proxy reads these samples only where the proxy itself passes them on. Neither the kernel plane
nor user data that goes past the proxy tells names. A sample in fragments is not read.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from rosproxy.ros2.protocol.graph_sample import node_names
from rosproxy.ros2.protocol.rtps import HEADER_BYTES, PREFIX_BYTES, RtpsError, samples
from rosproxy.ros2.registry.participants import AnyParticipant, ParticipantTable
from rosproxy.ros2.sources.rates import DiscoveryRates, Standing

WRITER_WITHIN = 96
"""The first bytes of a datagram, in which the writer of a sample must be named. With destination
and time before the sample, the writer is at 60."""


def _rates() -> DiscoveryRates:
    """The allowances for reading samples: a tenth of those for discovery."""
    return DiscoveryRates(1_000.0, 5_000.0, 1_000.0, 5_000.0)


@dataclass(slots=True)
class NodeNames:
    """Reads samples within the allowance of each source; other samples pass unread.

    ``standing`` is the standing of a source.
    """

    standing: Callable[[str], Standing]
    _rates: DiscoveryRates = field(default_factory=_rates)

    def read(
        self,
        side: ParticipantTable[AnyParticipant],
        datagram: bytes,
        source: str,
        now: float,
    ) -> None:
        """Note the nodes in a datagram of user data from a participant of a side, if any."""
        participant = side.find(datagram[HEADER_BYTES - PREFIX_BYTES : HEADER_BYTES], source)
        if participant is None or not participant.graph_writer:
            return
        writer = participant.graph_writer
        if datagram.find(writer, HEADER_BYTES, WRITER_WITHIN) < 0:
            return
        if not self._rates.take(source, len(datagram), now, self.standing(source)):
            return
        with suppress(RtpsError):
            for sample in samples(datagram):
                is_of_graph = sample.writer == int.from_bytes(writer, "big")
                if is_of_graph and sample.prefix == participant.prefix and sample.payload:
                    payload = datagram[sample.payload.start : sample.payload.end]
                    side.notes.note_nodes(participant, node_names(payload))
