"""What a RosProxy asks for of ROS 2, read: which versions, the domain, who is outside."""

from rosproxy.settings import LEAST_PER_DOMAIN
from rosproxy_operator.common.ros2 import LAST_DOMAIN, LEAST_PORTS, MOST_PEERS, read_peer_name
from rosproxy_operator.kubernetes.resources.fields import Field
from rosproxy_operator.kubernetes.resources.model import Ros2Spec

_VERSIONS = {"1": ("1",), "2": ("2",), "1,2": ("1", "2")}


def versions(field: Field) -> tuple[str, ...]:
    """The versions of ROS: 1 (as without the field), 2, or "1,2". Raises InvalidField."""
    value = "1" if field.value is None else field.value
    text = str(value).replace(" ", "") if type(value) in (int, str) else ""
    if text not in _VERSIONS:
        raise field.error("is unknown", "Write 1, 2 or '1,2'")
    return _VERSIONS[text]


def ros2_spec(field: Field, wanted: bool) -> Ros2Spec | None:
    """The fields of ROS 2 in a spec; None if it is not ``wanted``. Raises InvalidField."""
    if not wanted:
        for name in ("domain", "peers", "multicast"):
            if field[name].value not in (None, [], False):
                fix = "Remove the field, or set spec.ros: 2"
                raise field[name].error("is for ROS 2, but spec.ros is 1", fix)
        return None
    domain = field["domain"]
    return Ros2Spec(
        domain=None if domain.value is None else domain.number(0, 0, LAST_DOMAIN),
        peers=_peers(field["peers"]),
        multicast=field["multicast"].boolean(),
    )


def check_ports(field: Field, ports: int, ros2: Ros2Spec | None) -> None:
    """Raise InvalidField if there are too few ports for ROS 2."""
    least = LEAST_PORTS if ros2 and ros2.multicast else LEAST_PER_DOMAIN
    if ros2 and ports < least:
        fix = f"Write at least {least}: each participant takes three ports"
        raise field.error("is too low for ROS 2", fix)


def _peers(field: Field) -> tuple[str, ...]:
    listed = field.items()
    if len(listed) > MOST_PEERS:
        raise field.error("has too many hosts", f"Name at most {MOST_PEERS} hosts")
    return tuple(sorted({_peer(peer) for peer in listed}))


def _peer(field: Field) -> str:
    try:
        return read_peer_name(field.text())
    except ValueError:
        fix = "Write the robot's name or address, or HOST:PORT of another proxy"
        raise field.error("is not a peer", fix) from None
