"""Plans the actions for the Service of a RosProxy, and for the proxy on each node.

Each function compares the wanted object with the existing object, and yields the next action. Later
looks yield the further actions. The comparison reads only the fingerprint annotation. A pod with
another fingerprint is deleted, and a later look creates the pod again under the same name. If only
the image differs, the operator sets the image of the pod. `Retries` delays the repetition of an
action without an effect.
"""

from collections import Counter
from collections.abc import Iterable, Iterator

from rosproxy.net.addresses import is_address
from rosproxy.ros1.protocol.uris import parse_slave_uri
from rosproxy_operator.common.port_ranges import REFUSED_RANGE_KEPT_S
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateHelper,
    CreateProxy,
    CreateService,
    DeleteProxy,
    DeleteService,
    SetImage,
)
from rosproxy_operator.kubernetes.planner.cluster_view import serves
from rosproxy_operator.kubernetes.planner.manifests import ProxySite
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.context import ClusterContext, site_of
from rosproxy_operator.kubernetes.planner.steps.image_check import (
    ImageState,
    check_image,
    image_state,
)
from rosproxy_operator.kubernetes.resources.cluster import (
    Obstacle,
    PodFailure,
    ProxyPod,
    ProxyService,
)
from rosproxy_operator.kubernetes.resources.model import (
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    proxy_id,
    service_id,
)

RESTARTS_WITHIN_S = 60.0
"""Seconds in which a kubelet restarts a container after a change of the image."""
IN_TURN = 1.0
"""Seconds to the next look while a proxy waits for its turn in a rollout."""


def reconcile_service(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the action that creates the Service of a RosProxy, or deletes an outdated Service."""
    pods = context.view.selected_pods.get(rosproxy.id, ())
    wired = (master.host for pod in pods if (master := parse_slave_uri(pod.wired_master_uri)))
    static_peers = (pod.static_peers for pod in pods if not pod.wired_master_uri)
    hosts = Counter(host for host in (*wired, *static_peers) if is_address(host))
    # If the status has no address, the Service gets the address that most wired pods have.
    common = min(hosts, key=lambda host: (-hosts[host], host), default="")
    body = manifests.service(rosproxy, rosproxy.cluster_ip or common)
    service = context.observed.services.get(rosproxy.id)
    if service is None:
        if context.retries.is_due(Task(rosproxy.id, "create", service_id(rosproxy.id))):
            yield CreateService(rosproxy.id, body)
    elif service.owner != rosproxy.uid:
        yield from _delete_service(context, service, "its former RosProxy is gone")
    elif service.fingerprint != manifests.fingerprint_of(body):
        # A later look creates the Service again, with the address that the status keeps.
        yield from _delete_service(
            context, service, "replaced, since the RosProxy or the operator has changed"
        )


def _delete_service(context: ClusterContext, service: ProxyService, why: str) -> Iterator[Action]:
    """Yield the deletion of a Service, unless the Service is being deleted already."""
    name = service_id(service.of)
    if not service.deleting and context.retries.is_due(
        Task(service.of, "delete", name, service.uid)
    ):
        yield DeleteService(service.of, name, service.uid, why)


def reconcile_proxies(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the next actions for the proxies of a RosProxy.

    A change of the image or of the settings is a rollout. At the same time, at most
    ``spec.maxUnavailable`` proxies do not work or have a check of the next image. The next proxy
    waits until these proxies work again. A proxy that moves to other ports or to another master
    does not wait.
    """
    places = context.view.places.get(rosproxy.id, ())
    wanted = [place for place in places if _can_be_had(context, place)]
    working = {place for place in wanted if _works(context, place, wanted)}
    away = [p for p in wanted if p not in working and not _lacks_ports(context, p)]
    tried = [place for place in working if _is_tried(context, place)]
    room = rosproxy.spec.max_unavailable.of(len(wanted)) - len(away) - len(tried)
    for place in places:
        may_stop = room > 0 or place not in working
        actions = [*_reconcile_proxy(context, place, may_stop)]
        begins = any(isinstance(a, DeleteProxy | SetImage | CreateHelper) for a in actions)
        room -= begins and place in working
        yield from actions


def _is_tried(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether the check of a proxy's next image is under way or has failed."""
    current = context.view.current.get(place)
    site = site_of(context, place)
    if current is None or not isinstance(site, ProxySite):
        return False
    if current.image == manifests.image_of(site.rosproxy, context.settings):
        return False
    return image_state(context, current, site) in (ImageState.CHECKING, ImageState.UNUSABLE)


def _lacks_ports(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether a proxy waits for its ports. No rollout has caused this, so no rollout waits."""
    current = context.view.current.get(place)
    return current is not None and current.stuck is PodFailure.PORTS


def _can_be_had(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether a proxy is wanted, and has no obstacle."""
    return place in context.view.wanted and not isinstance(site_of(context, place), Obstacle)


def _works(context: ClusterContext, place: ProxyPlace, places: Iterable[ProxyPlace]) -> bool:
    """Whether a proxy serves, with the image of its pod, and is ready.

    If no proxy of ``places`` is ready, readiness does not count: the master may be down.
    """
    current = context.view.current.get(place)
    if current is None or not serves(current) or current.stuck is not None:
        return False
    # After a change of the image, a pod stays ready until the kubelet ends the former container.
    if context.retries.is_recent(_setting_image(current, current.image), RESTARTS_WITHIN_S):
        return False
    every = filter(None, map(context.view.current.get, places))
    return current.ready or not any(proxy.ready for proxy in every)


def _reconcile_proxy(
    context: ClusterContext, place: ProxyPlace, may_stop: bool
) -> Iterator[Action]:
    """Yield the next actions for a proxy. ``may_stop``: a rollout may stop the proxy now."""
    node = context.observed.nodes.get(place.node)
    proxies = context.view.proxies.get(place, ())
    if place in context.view.wanted:
        site = site_of(context, place)
        if isinstance(site, Obstacle):
            _note_creation(context, place)
        else:
            yield from _ensure(context, place, site, may_stop)
    elif node is None:
        for proxy in proxies if context.seconds_until_lost(place.node) <= 0 else ():
            yield from _delete_pod(context, proxy, "its node is gone")
    elif node.ready and not node.deleting and context.grace_left(place) <= 0:
        grace = context.view.rosproxies[place.of].spec.grace
        for proxy in proxies:
            why = f"no pod on node {place.node} has needed the proxy for {grace:g} s"
            yield from _delete_pod(context, proxy, why, retire=True)


def _ensure(
    context: ClusterContext, place: ProxyPlace, site: ProxySite, may_stop: bool
) -> Iterator[Action]:
    """Yield the next action for a wanted proxy without an obstacle."""
    name = proxy_id(place.of, place.node)
    current = context.view.current.get(place)
    misplaced = [p for p in context.view.proxies.get(place, ()) if p.pod.id != name]
    if misplaced:
        for proxy in misplaced:
            yield from _delete_pod(context, proxy, "the proxy of this node has another name")
    elif name in context.view.names:
        _note_creation(context, place)
        if current is not None:  # otherwise the pod with this name is deleted first
            yield from _update(context, current, site, may_stop)
    elif (seconds := context.seconds_until_torn_down(place)) > 0:
        # A pod that was deleted by force may still hold its hostPorts: see `TORN_DOWN_WITHIN_S`.
        context.retries.look_again_in(seconds)
    elif context.retries.is_due(_creation(place)):
        yield CreateProxy(place.of, manifests.proxy_pod(site, context.settings))


def _update(
    context: ClusterContext, proxy: ProxyPod, site: ProxySite, may_stop: bool
) -> Iterator[Action]:
    image = manifests.image_of(site.rosproxy, context.settings)
    fingerprint = manifests.proxy_fingerprint(site, context.settings)
    if proxy.pod.ended:
        yield from _delete_pod(
            context, proxy, f"the pod has ended: {proxy.message or proxy.pod.phase}"
        )
    elif proxy.fingerprint == fingerprint and proxy.image == image:
        return
    elif serves(proxy) and proxy.stuck is None and proxy.image != image:
        state = image_state(context, proxy, site)
        if state is ImageState.USABLE:
            yield from _change(context, proxy, site, may_stop)
        elif state is ImageState.MISSING and may_stop:
            yield from check_image(context, site)
    else:
        yield from _change(context, proxy, site, may_stop)


def _change(
    context: ClusterContext, proxy: ProxyPod, site: ProxySite, may_stop: bool
) -> Iterator[Action]:
    """Yield the deletion of a proxy that has to be recreated, or the change of the image.

    A proxy that moves to other ports or to another master does not wait for its turn.
    """
    image = manifests.image_of(site.rosproxy, context.settings)
    fingerprint = manifests.proxy_fingerprint(site, context.settings)
    # If the next proxy can't find the nodes at the master, the present proxy unregisters the nodes
    # (`retire`). A range with the same first port has only grown or shrunk at the end, so the
    # nodes keep their ports.
    moved = proxy.range.first != site.ports.first
    lost = moved or not manifests.keeps_registrations(proxy.fingerprint, fingerprint)
    if not may_stop and not lost:
        context.retries.look_again_in(IN_TURN)
    elif proxy.fingerprint != fingerprint:
        why = "replaced, since the RosProxy, the node or the operator's options have changed"
        if proxy.range != site.ports:
            why = f"replaced, since the ports change from {proxy.range} to {site.ports}"
        yield from _delete_pod(context, proxy, why, retire=serves(proxy) and lost)
    elif context.retries.is_due(_setting_image(proxy, image)):
        yield SetImage(proxy.of, proxy.pod.id, proxy.pod.uid, image)


def _setting_image(proxy: ProxyPod, image: str) -> Task:
    """The task that sets an image. The task is another one after each restart of the container."""
    return Task(proxy.of, "image", proxy.pod.id, f"{proxy.pod.uid} {proxy.restarts} {image}")


def _delete_pod(
    context: ClusterContext, proxy: ProxyPod, why: str, retire: bool = False
) -> Iterator[Action]:
    """Yield the deletion of a proxy's pod, unless the pod is being deleted already.

    With ``retire`` the proxy first unregisters its nodes. A pod that is being deleted may still do
    this, because the garbage collector often deletes a pod before the operator acts.
    """
    node = context.observed.nodes.get(proxy.node)
    runs = serves(proxy) and node is not None and node.ready
    useful = not proxy.pod.deleting or (retire and runs)
    if useful and context.retries.is_due(Task(proxy.of, "delete", proxy.pod.id, proxy.pod.uid)):
        yield DeleteProxy(proxy.of, proxy.pod.id, proxy.pod.uid, why, retire)


def _note_creation(context: ClusterContext, place: ProxyPlace) -> None:
    """Keep the count of creations of a proxy until the proxy serves: see `PROMPT_RECREATIONS`."""
    current = context.view.current.get(place)
    if current is None or not serves(current):
        context.retries.note_effect(_creation(place))


def _creation(place: ProxyPlace) -> Task:
    return Task(place.of, "create", proxy_id(place.of, place.node))


def reconcile_orphans(context: ClusterContext) -> Iterator[Action]:
    """Yield the deletion of the proxies and Services of RosProxies that are gone.

    The garbage collector of the cluster may delete these objects first.
    """
    for proxy in context.view.orphans:
        # A new RosProxy with the same name takes over the nodes at the master, so the orphan must
        # not unregister the nodes.
        takes_over = proxy.of in context.view.rosproxies
        yield from _delete_pod(context, proxy, "its RosProxy is gone", retire=not takes_over)
    unusable = {r.uid for r in context.observed.unusable.values()}
    for service in context.observed.services.values():
        if service.of not in context.view.rosproxies and service.owner not in unusable:
            yield from _delete_service(context, service, "its RosProxy is gone")


def ends(context: ClusterContext) -> Iterator[float]:
    """Yield the seconds to the end of each period of the state. No event tells such an end."""
    ready = {name for name, node in context.observed.nodes.items() if node.ready}
    yield from (context.grace_left(place) for place in context.state.absent if place.node in ready)
    yield from map(context.seconds_until_lost, context.state.lost)
    yield from (at + REFUSED_RANGE_KEPT_S - context.now for at in context.state.refused.values())
