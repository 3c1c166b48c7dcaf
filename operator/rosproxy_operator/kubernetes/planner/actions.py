"""What the operator can do to a cluster: data, carried out by `apply`."""

from typing import ClassVar

import msgspec

from rosproxy_operator.kubernetes.resources.model import Json, Name, Reference


class ClusterAction(msgspec.Struct, frozen=True):
    """Something to be done for the RosProxy ``of``."""

    of: Name


class ObjectAction(ClusterAction, frozen=True):
    """Something to be done to the object ``id``, if it still has this uid."""

    id: Name
    uid: str


class Creation(ClusterAction, frozen=True):
    """Create an object. ``body`` is the whole object."""

    body: Json

    @property
    def kind(self) -> str:
        """The kind of the object."""
        return str(self.body["kind"])


class Deletion(ObjectAction, frozen=True):
    """Delete an object of this ``kind`` that is not as it ought to be, or ought not to exist."""

    kind: ClassVar[str] = "Pod"
    why: str


class CreateService(Creation, frozen=True):
    """Create the Service of a RosProxy."""


class DeleteService(Deletion, frozen=True):
    """Delete the Service of a RosProxy."""

    kind = "Service"


class CreatePolicy(Creation, frozen=True):
    """Create the NetworkPolicy of a RosProxy."""


class SetPolicy(ObjectAction, frozen=True):
    """Give a NetworkPolicy the spec that it ought to have."""

    spec: Json


class DeletePolicy(Deletion, frozen=True):
    """Delete the NetworkPolicy of a RosProxy."""

    kind = "NetworkPolicy"


class CreateProxy(Creation, frozen=True):
    """Create a proxy's pod."""


class DeleteProxy(Deletion, frozen=True):
    """Delete a proxy's pod.

    With ``retire`` its nodes are unregistered at the master first: no proxy takes over.
    """

    retire: bool = False


class CreateHelper(Creation, frozen=True):
    """Create a pod beside a proxy: its LAN relay or an image check, by ``component`` (`names`)."""

    component: str


class DeleteHelper(Deletion, frozen=True):
    """Delete a pod beside a proxy."""

    component: str


class EvictPod(ObjectAction, frozen=True):
    """Evict a user's pod that its controller makes anew."""

    why: str


class SetImage(ObjectAction, frozen=True):
    """Give a proxy's pod another image: its ports and its address stay."""

    image: str


class PatchStatus(ClusterAction, frozen=True):
    """Replace the status of a RosProxy, if it still has this uid."""

    uid: str
    status: Json


class Emit(ClusterAction, frozen=True):
    """Make a Kubernetes Event.

    ``type`` is Normal or Warning. The same event is made once, and counted when it comes again.
    """

    about: Reference
    type: str
    reason: str
    message: str


Action = Creation | Deletion | EvictPod | SetPolicy | SetImage | PatchStatus | Emit
