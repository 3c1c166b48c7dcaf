"""What the operator can do to a cluster: data, carried out by `apply`."""

import msgspec

from rosproxy_operator.kubernetes.resources.model import Json, Name, Reference


class ClusterAction(msgspec.Struct, frozen=True):
    """Something to be done for the RosProxy ``of``."""

    of: Name


class ObjectAction(ClusterAction, frozen=True):
    """Something to be done to the object ``id``, if it still has this uid."""

    id: Name
    uid: str


class CreateService(ClusterAction, frozen=True):
    """Create the Service of a RosProxy. ``body`` is the whole object."""

    body: Json


class DeleteService(ObjectAction, frozen=True):
    """Delete a Service that is not as it ought to be."""

    why: str


class CreatePolicy(ClusterAction, frozen=True):
    """Create the NetworkPolicy of a RosProxy. ``body`` is the whole object."""

    body: Json


class SetPolicy(ObjectAction, frozen=True):
    """Give a NetworkPolicy the spec that it ought to have."""

    spec: Json


class DeletePolicy(ObjectAction, frozen=True):
    """Delete a NetworkPolicy that ought not to exist."""

    why: str


class CreateProxy(ClusterAction, frozen=True):
    """Create a proxy's pod. ``body`` is the whole object."""

    body: Json


class DeleteProxy(ObjectAction, frozen=True):
    """Delete a proxy's pod.

    With ``retire`` its nodes are unregistered at the master first: no proxy takes over.
    """

    why: str
    retire: bool = False


class CreateHelper(ClusterAction, frozen=True):
    """Create a pod beside a proxy: its LAN relay, or an image check.

    ``component`` says which (`names`), ``body`` is the whole object.
    """

    component: str
    body: Json


class DeleteHelper(ObjectAction, frozen=True):
    """Delete a pod beside a proxy."""

    component: str
    why: str


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


Action = (
    CreateService
    | DeleteService
    | CreatePolicy
    | SetPolicy
    | DeletePolicy
    | CreateProxy
    | DeleteProxy
    | CreateHelper
    | DeleteHelper
    | EvictPod
    | SetImage
    | PatchStatus
    | Emit
)
