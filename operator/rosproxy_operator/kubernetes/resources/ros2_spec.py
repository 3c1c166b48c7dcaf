"""What a RosProxy asks for of ROS 2, read: which versions, the domain, who is outside."""

from rosproxy.settings import LEAST_PER_DOMAIN
from rosproxy_operator.common.ros2 import LAST_DOMAIN, LEAST_PORTS, MOST_PEERS, read_peer_name
from rosproxy_operator.kubernetes.resources.fields import Field
from rosproxy_operator.kubernetes.resources.model import Ros2Spec

_VERSIONS = {"1": ("1",), "2": ("2",), "1,2": ("1", "2")}


def versions(given: Field) -> tuple[str, ...]:
    """The versions of ROS: 1 (as without the field), 2, or "1,2". Raises InvalidField."""
    value = "1" if given.value is None else given.value
    found = str(value).replace(" ", "") if type(value) in (int, str) else ""
    if found not in _VERSIONS:
        raise given.refused("is unknown", "write 1, 2 or '1,2'")
    return _VERSIONS[found]


def ros2_spec(given: Field, wanted: bool) -> Ros2Spec | None:
    """The fields of ROS 2 in a spec; None if it is not ``wanted``. Raises InvalidField."""
    if not wanted:
        for name in ("domain", "peers", "multicast"):
            if given[name].value not in (None, [], False):
                fix = "leave it out, or set spec.ros: 2"
                raise given[name].refused("is for ROS 2, which spec.ros leaves out", fix)
        return None
    domain = given["domain"]
    return Ros2Spec(
        domain=None if domain.value is None else domain.number(0, 0, LAST_DOMAIN),
        peers=_peers(given["peers"]),
        multicast=given["multicast"].truth(),
    )


def check_ports(given: Field, ports: int, ros2: Ros2Spec | None) -> None:
    """Raise InvalidField if there are too few ports for ROS 2."""
    least = LEAST_PORTS if ros2 and ros2.multicast else LEAST_PER_DOMAIN
    if ros2 and ports < least:
        fix = f"ask for {least} at least: each participant takes three"
        raise given.refused("are too few for ROS 2", fix)


def _peers(given: Field) -> tuple[str, ...]:
    listed = given.each()
    if len(listed) > MOST_PEERS:
        raise given.refused("are too many", f"name {MOST_PEERS} hosts at most")
    return tuple(sorted({_peer(one) for one in listed}))


def _peer(given: Field) -> str:
    try:
        return read_peer_name(given.text())
    except ValueError:
        fix = "write the robot's name or address, or HOST:PORT of another proxy"
        raise given.refused("is no peer", fix) from None
