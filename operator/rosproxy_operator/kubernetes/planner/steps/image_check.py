"""Checks that a node can pull and run the next image of a proxy, before the proxy gets the image.

A kubelet ends a container before the kubelet pulls another image (kuberuntime_manager.go, SyncPod).
With an image that the node can't pull, the proxy would not run until a user corrects the image. So
the operator first creates a pod with the next image on the node. This pod prints the version and
ends. The proxy gets the image only after the pod has succeeded.
"""

from collections.abc import Iterator
from enum import Enum

from rosproxy_operator.kubernetes.planner.actions import Action, CreateHelper, DeleteHelper
from rosproxy_operator.kubernetes.planner.manifests import (
    ProxySite,
    fingerprint_of,
    helper_pod,
    image_of,
)
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.context import ClusterContext, site_of
from rosproxy_operator.kubernetes.resources.cluster import HelperPod
from rosproxy_operator.kubernetes.resources.model import Json, ProxyPlace, RosProxy
from rosproxy_operator.kubernetes.resources.names import IMAGE_CHECK, image_check_id
from rosproxy_operator.kubernetes.settings import ClusterSettings

_COMMAND = ("rosproxy", "--version")
_RESOURCES: Json = {"requests": {"cpu": "1m", "memory": "32Mi"}, "limits": {"memory": "128Mi"}}


class ImageState(Enum):
    """The result of the check of an image on a node."""

    UNCHECKED = "unchecked"  # no check of this image exists, or the check is being deleted
    CHECKING = "checking"
    USABLE = "usable"
    UNUSABLE = "unusable"


def image_check_pod(site: ProxySite, settings: ClusterSettings) -> Json:
    """The pod that checks the image of a proxy."""
    container = {
        "name": IMAGE_CHECK,
        "image": image_of(site.rosproxy, settings),
        "command": [*_COMMAND],
        "resources": _RESOURCES,
    }
    id = image_check_id(site.rosproxy.id, site.node.name)
    return helper_pod(site, id, settings, container, {"restartPolicy": "Never"})


def image_state(context: ClusterContext, site: ProxySite) -> ImageState:
    """The result of the check of a proxy's next image, on the proxy's node."""
    expected = fingerprint_of(image_check_pod(site, context.settings))
    check = _check_at(context, site)
    if check is None or check.fingerprint != expected or check.pod.deleting:
        return ImageState.UNCHECKED
    if check.pod.phase == "Succeeded":
        return ImageState.USABLE
    is_bad = check.stuck is not None or check.pod.ended
    return ImageState.UNUSABLE if is_bad else ImageState.CHECKING


def check_image(context: ClusterContext, site: ProxySite) -> Iterator[Action]:
    """Yield the action that creates the check of a proxy's next image, if no check exists."""
    rosproxy_id = site.rosproxy.id
    id = image_check_id(rosproxy_id, site.node.name)
    # A check of another image has the same name. `remove_image_checks` deletes that check first.
    is_there = _check_at(context, site) is not None
    if not is_there and context.retries.is_due(Task(rosproxy_id, "create", id)):
        yield CreateHelper(rosproxy_id, image_check_pod(site, context.settings), IMAGE_CHECK)


def remove_image_checks(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the actions that delete image checks that no proxy of the RosProxy needs any more."""
    for check in context.observed.image_checks:
        if check.owner != rosproxy.uid:
            continue
        task = Task(check.of, "delete", check.pod.id, check.pod.uid)
        if check.pod.deleting or _is_needed(context, rosproxy, check):
            continue
        if context.retries.is_due(task):
            why = "the proxy has the image, needs another image, or is gone or unwanted"
            yield DeleteHelper(check.of, check.pod.id, check.pod.uid, why, IMAGE_CHECK)


def _is_needed(context: ClusterContext, rosproxy: RosProxy, check: HelperPod) -> bool:
    place = ProxyPlace(rosproxy.id, check.node)
    current = context.view.current.get(place)
    site = site_of(context, place) if place in context.view.wanted else None
    if current is None or not isinstance(site, ProxySite):
        return False
    is_next = current.image != image_of(rosproxy, context.settings)
    return is_next and check.fingerprint == fingerprint_of(image_check_pod(site, context.settings))


def _check_at(context: ClusterContext, site: ProxySite) -> HelperPod | None:
    """The check that exists for a proxy, of its next image or of another image."""
    checks = context.view.image_checks_by_node.get(site.node.name, ())
    return next((c for c in checks if c.owner == site.rosproxy.uid), None)
