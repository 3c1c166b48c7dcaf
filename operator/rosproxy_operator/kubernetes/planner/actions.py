"""What the operator can do to a cluster: data, carried out by `rosproxy_operator.kubernetes`."""

from dataclasses import dataclass

from rosproxy_operator.kubernetes.resources.model import Json, Name


@dataclass(frozen=True, slots=True)
class CreateService:
    """Create the Service of a RosProxy. ``body`` is the whole object."""

    of: Name
    body: Json


@dataclass(frozen=True, slots=True)
class DeleteService:
    """Delete a Service that is not as it ought to be, if it still has this uid."""

    of: Name
    id: Name
    uid: str
    why: str


@dataclass(frozen=True, slots=True)
class CreateProxy:
    """Create a proxy's pod on a node. ``body`` is the whole object."""

    of: Name
    node: str
    body: Json


@dataclass(frozen=True, slots=True)
class DeleteProxy:
    """Delete a proxy's pod, if it still has this uid.

    With ``retire`` its nodes are unregistered at the master first: nobody takes over.
    """

    of: Name
    id: Name
    uid: str
    why: str
    retire: bool = False


@dataclass(frozen=True, slots=True)
class SetImage:
    """Give a proxy's pod another image: its ports and its address stay."""

    of: Name
    id: Name
    uid: str
    image: str


@dataclass(frozen=True, slots=True)
class PatchStatus:
    """Replace the status of a RosProxy."""

    of: Name
    status: Json


@dataclass(frozen=True, slots=True)
class Emit:
    """Make a Kubernetes Event. ``about`` is its ``involvedObject``.

    ``type`` is Normal or Warning. The same event is made once, and counted when it comes again.
    """

    of: Name
    about: Json
    type: str
    reason: str
    message: str


Action = CreateService | DeleteService | CreateProxy | DeleteProxy | SetImage | PatchStatus | Emit
