"""The actions of the operator in a cluster, as data. `apply` carries out the actions."""

from typing import ClassVar

import msgspec

from rosproxy_operator.kubernetes.resources.model import Json, Name, Reference


class ClusterAction(msgspec.Struct, frozen=True):
    """An action for the RosProxy ``of``."""

    of: Name


class ObjectAction(ClusterAction, frozen=True):
    """An action on the object ``id``, only if the uid still matches."""

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
    """Delete an object that is wrong or no longer needed.

    ``kind`` is the kind of the object. ``why`` gives the reason for the log and the Event.
    """

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
    """Replace the spec of a NetworkPolicy."""

    spec: Json


class DeletePolicy(Deletion, frozen=True):
    """Delete the NetworkPolicy of a RosProxy."""

    kind = "NetworkPolicy"


class CreateProxy(Creation, frozen=True):
    """Create a proxy's pod."""


class DeleteProxy(Deletion, frozen=True):
    """Delete a proxy's pod.

    With ``retire``, no other proxy takes over, so the proxy first unregisters its nodes at the
    master.
    """

    retire: bool = False


class CreateHelper(Creation, frozen=True):
    """Create a pod beside a proxy: a LAN relay or an image check, by ``component`` (`names`)."""

    component: str


class DeleteHelper(Deletion, frozen=True):
    """Delete a pod beside a proxy."""

    component: str


class EvictPod(ObjectAction, frozen=True):
    """Evict a user's pod. The pod's controller, such as a ReplicaSet, creates the pod again."""

    why: str


class SetImage(ObjectAction, frozen=True):
    """Replace the image of a proxy's pod. The pod keeps its ports and address."""

    image: str


class PatchStatus(ClusterAction, frozen=True):
    """Replace the status of a RosProxy, only if the uid still matches."""

    uid: str
    status: Json


class Emit(ClusterAction, frozen=True):
    """Create a Kubernetes Event. If the same Event exists, increase its count instead.

    ``type`` is Normal or Warning.
    """

    about: Reference
    type: str
    reason: str
    message: str


Action = Creation | Deletion | EvictPod | SetPolicy | SetImage | PatchStatus | Emit
