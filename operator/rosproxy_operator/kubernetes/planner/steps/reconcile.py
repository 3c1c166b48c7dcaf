"""Plans the actions for the Service of a RosProxy, and for the proxy on each node.

Each ``reconcile_…`` function compares the wanted objects with the existing objects, and yields the
next actions. Later looks yield the actions after these. An object with another owner or name is
deleted. Of the content, the comparison reads only the fingerprint annotation and the image. A pod
with another fingerprint is deleted, and a later look creates the pod again under the same name. If
only the image differs, the operator sets the image of the pod. `Retries` delays the next try of an
action that had no effect.
"""

from collections import Counter
from collections.abc import Iterator

from msgspec.structs import replace

from rosproxy.shared.addresses import is_address
from rosproxy.shared.uris import parse_slave_uri
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
from rosproxy_operator.kubernetes.planner.cluster_view import place_of, serves
from rosproxy_operator.kubernetes.planner.manifests import ProxySite
from rosproxy_operator.kubernetes.planner.retries import Task
from rosproxy_operator.kubernetes.planner.steps.context import (
    ClusterContext,
    hubs_of,
    peers_of,
    site_of,
)
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
    Json,
    ProxyPlace,
    RosProxy,
)
from rosproxy_operator.kubernetes.resources.names import (
    proxy_id,
    router_host,
    service_id,
)
from rosproxy_operator.kubernetes.resources.objects import name_of

IMAGE_CHANGE_RESTART_S = 60.0
"""Seconds in which a kubelet restarts a container after a change of the image."""
ROLLOUT_RECHECK_S = 1.0
"""Seconds to the next look while a proxy waits for its turn in a rollout."""


def reconcile_service(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the action that creates the Service of a RosProxy, or deletes an outdated Service."""
    pods = context.view.selected_pods.get(rosproxy.id, ())
    wired = (master.host for pod in pods if (master := parse_slave_uri(pod.wired_master_uri)))
    static_peers = (pod.static_peers for pod in pods if not pod.wired_master_uri)
    routers = (router_host(pod.router_endpoint) for pod in pods)
    hosts = Counter(host for host in (*wired, *static_peers, *routers) if is_address(host))
    # If the status has no address, the Service gets the address to which most pods are wired.
    most_wired = min(hosts, key=lambda host: (-hosts[host], host), default="")
    body = manifests.service(rosproxy, rosproxy.cluster_ip or most_wired)
    service = context.observed.services.get(rosproxy.id)
    if service is None:
        if context.retries.is_due(Task(rosproxy.id, "create", service_id(rosproxy.id))):
            yield CreateService(rosproxy.id, body)
    else:
        # A later look creates the Service again, with the address that the status keeps.
        yield from _replace_service(context, rosproxy, service, body)


def reconcile_hubs_service(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the action that creates or deletes the headless Service for rmw_zenoh."""
    service = context.observed.hub_services.get(rosproxy.id)
    body = manifests.hubs_service(rosproxy) if rosproxy.spec.zenoh else None
    yield from _reconcile_zenoh_service(context, rosproxy, service, body, "spec.ros is not zenoh")


def reconcile_outside_service(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the action that creates or deletes the Service at which outside reaches rmw_zenoh."""
    service = context.observed.outside_services.get(rosproxy.id)
    listen = rosproxy.spec.zenoh.listen if rosproxy.spec.zenoh else None
    body = manifests.outside_service(rosproxy, listen) if listen else None
    yield from _reconcile_zenoh_service(context, rosproxy, service, body, "spec.listen is not set")


def _reconcile_zenoh_service(
    context: ClusterContext,
    rosproxy: RosProxy,
    service: ProxyService | None,
    body: Json | None,
    why_not: str,
) -> Iterator[Action]:
    """Yield the action that creates, replaces or deletes a Service; ``body`` None: not wanted."""
    if body is None:
        if service is not None:
            yield from _delete_service(context, service, why_not)
    elif service is not None:
        yield from _replace_service(context, rosproxy, service, body)
    elif context.retries.is_due(Task(rosproxy.id, "create", name_of(body["metadata"]))):
        yield CreateService(rosproxy.id, body)


def _replace_service(
    context: ClusterContext, rosproxy: RosProxy, service: ProxyService, body: Json
) -> Iterator[Action]:
    """Yield the deletion of a Service that differs from ``body``."""
    if service.owner != rosproxy.uid:
        yield from _delete_service(context, service, "its former RosProxy is gone")
    elif service.fingerprint != manifests.fingerprint_of(body):
        yield from _delete_service(
            context, service, "replaced, since the RosProxy or the operator has changed"
        )


def _delete_service(context: ClusterContext, service: ProxyService, why: str) -> Iterator[Action]:
    """Yield the deletion of a Service, unless the Service is being deleted already."""
    name = service.id
    if not service.deleting and context.retries.is_due(
        Task(service.of, "delete", name, service.uid)
    ):
        yield DeleteService(service.of, name, service.uid, why)


def reconcile_proxies(context: ClusterContext, rosproxy: RosProxy) -> Iterator[Action]:
    """Yield the next actions for the proxies of a RosProxy.

    A change of the image or of the settings is a rollout. A rollout stops a working proxy, or
    checks its next image, only while fewer than ``spec.maxUnavailable`` proxies are down or have
    such a check. The other proxies wait for their turn. A proxy that moves to other ports or to
    another master does not wait for its turn. If the image changes as well, the operator first
    checks the image, and the proxy waits for its turn to begin this check.
    """
    places = context.view.places.get(rosproxy.id, ())
    creatable = [place for place in places if _is_creatable(context, place)]
    existing = [*filter(None, map(context.view.current.get, creatable))]
    # If no proxy is ready, readiness does not count: the master may be down.
    has_ready = any(proxy.ready for proxy in existing)
    working = {place_of(proxy) for proxy in existing if _works(context, proxy, has_ready)}
    down = [p for p in creatable if p not in working and not _lacks_ports(context, p)]
    in_check = [place for place in working if _image_check_is_open(context, place)]
    room = rosproxy.spec.max_unavailable.of(len(creatable)) - len(down) - len(in_check)
    for place in places:
        may_stop = room > 0 or place not in working
        actions = [*_reconcile_proxy(context, place, may_stop)]
        begins = any(isinstance(a, DeleteProxy | SetImage | CreateHelper) for a in actions)
        room -= begins and place in working
        yield from actions


def _image_check_is_open(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether the check of a proxy's next image is under way or has failed."""
    current = context.view.current.get(place)
    site = site_of(context, place)
    if current is None or not isinstance(site, ProxySite):
        return False
    if current.image == manifests.image_of(site.rosproxy, context.settings):
        return False
    return image_state(context, site) in (ImageState.CHECKING, ImageState.UNUSABLE)


def _lacks_ports(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether a proxy's pod does not run because its ports are taken.

    A rollout does not count such a proxy as down: no rollout has caused the lack of ports.
    """
    current = context.view.current.get(place)
    return current is not None and current.stuck is PodFailure.PORTS


def _is_creatable(context: ClusterContext, place: ProxyPlace) -> bool:
    """Whether a proxy is wanted, and has no obstacle."""
    return place in context.view.wanted and not isinstance(site_of(context, place), Obstacle)


def _works(context: ClusterContext, proxy: ProxyPod, must_be_ready: bool) -> bool:
    """Whether a proxy serves, and is ready if it must be.

    After a change of the image, the answer is False until the container restarts, for
    `IMAGE_CHANGE_RESTART_S` seconds at most.
    """
    if not serves(proxy) or proxy.stuck is not None:
        return False
    # After a change of the image, a pod stays ready until the kubelet ends the former container.
    if context.retries.is_recent(_image_task(proxy, proxy.image), IMAGE_CHANGE_RESTART_S):
        return False
    return proxy.ready or not must_be_ready


def _reconcile_proxy(
    context: ClusterContext, place: ProxyPlace, may_stop: bool
) -> Iterator[Action]:
    """Yield the next actions for a proxy. ``may_stop``: a rollout may stop the proxy now."""
    node = context.observed.nodes.get(place.node)
    proxies = context.view.proxies.get(place, ())
    if place in context.view.wanted:
        site = site_of(context, place)
        if isinstance(site, Obstacle):
            _keep_creation_count(context, place)
        else:
            yield from _reconcile_wanted(context, place, site, may_stop)
    elif node is None:
        for proxy in proxies if context.seconds_until_lost(place.node) <= 0 else ():
            yield from _delete_pod(context, proxy, "its node is gone")
    elif node.ready and not node.deleting and context.grace_left(place) <= 0:
        grace = context.view.rosproxies[place.of].spec.grace
        for proxy in proxies:
            why = f"no pod on node {place.node} has needed the proxy for {grace:g} s"
            yield from _delete_pod(context, proxy, why, retire=True)


def _reconcile_wanted(
    context: ClusterContext, place: ProxyPlace, site: ProxySite, may_stop: bool
) -> Iterator[Action]:
    """Yield the next action for a wanted proxy without an obstacle."""
    name = proxy_id(place.of, place.node)
    current = context.view.current.get(place)
    misnamed = [p for p in context.view.proxies.get(place, ()) if p.pod.id != name]
    if misnamed:
        for proxy in misnamed:
            yield from _delete_pod(context, proxy, "the pod has a former name")
    elif name in context.view.names:
        _keep_creation_count(context, place)
        if current is not None:  # None: a pod with this name is still being deleted
            yield from _reconcile_existing(context, current, site, may_stop)
    elif (seconds := context.seconds_until_torn_down(place)) > 0:
        # A pod that was deleted by force may still hold its hostPorts: see `TORN_DOWN_WITHIN_S`.
        context.retries.look_again_in(seconds)
    elif context.retries.is_due(_creation_task(place)):
        site = replace(site, peers=peers_of(context, place), hubs=hubs_of(context, place))
        yield CreateProxy(place.of, manifests.proxy_pod(site, context.settings))


def _reconcile_existing(
    context: ClusterContext, proxy: ProxyPod, site: ProxySite, may_stop: bool
) -> Iterator[Action]:
    """Yield the next action for a wanted proxy whose pod exists."""
    image = manifests.image_of(site.rosproxy, context.settings)
    fingerprint = manifests.proxy_fingerprint(site, context.settings)
    if proxy.pod.ended:
        yield from _delete_pod(
            context, proxy, f"the pod has ended: {proxy.message or proxy.pod.phase}"
        )
    elif proxy.fingerprint == fingerprint and proxy.image == image:
        report = context.observed.reports.get(proxy.pod.uid)
        # The deletion was called off after the proxy had unregistered its nodes: the spec was
        # changed back, a pod was selected again, or another operator has begun.
        if report is not None and report.retired:
            why = "the proxy has unregistered its nodes, and accepts no others"
            yield from _delete_pod(context, proxy, why, retire=True)
    elif serves(proxy) and proxy.stuck is None and proxy.image != image:
        state = image_state(context, site)
        if state is ImageState.USABLE:
            yield from _replace_or_set_image(context, proxy, site, may_stop)
        elif state is ImageState.UNCHECKED and may_stop:
            yield from check_image(context, site)
    else:
        yield from _replace_or_set_image(context, proxy, site, may_stop)


def _replace_or_set_image(
    context: ClusterContext, proxy: ProxyPod, site: ProxySite, may_stop: bool
) -> Iterator[Action]:
    """Yield the deletion of a proxy that has to be recreated, or the change of the image.

    Here, a proxy that moves to other ports or to another master does not wait for its turn.
    """
    image = manifests.image_of(site.rosproxy, context.settings)
    fingerprint = manifests.proxy_fingerprint(site, context.settings)
    # If the successor can't find the nodes at the master, the present proxy unregisters the nodes
    # (`retire`). A range with the same first port has only grown or shrunk at the end. So the
    # nodes keep their ports, except nodes at ports that were cut off at the end.
    moved = proxy.range.first != site.ports.first
    unregisters = moved or not manifests.keeps_registrations(proxy.fingerprint, fingerprint)
    if not may_stop and not unregisters:
        context.retries.look_again_in(ROLLOUT_RECHECK_S)
    elif proxy.fingerprint != fingerprint:
        why = "replaced, since the RosProxy, the node or the operator's options have changed"
        if proxy.range != site.ports:
            why = f"replaced, since the ports change from {proxy.range} to {site.ports}"
        yield from _delete_pod(context, proxy, why, retire=serves(proxy) and unregisters)
    elif context.retries.is_due(_image_task(proxy, image)):
        yield SetImage(proxy.of, proxy.pod.id, proxy.pod.uid, image)


def _image_task(proxy: ProxyPod, image: str) -> Task:
    """The task that sets an image.

    After each restart of the container this is another task, without a pause from earlier tries.
    """
    return Task(proxy.of, "image", proxy.pod.id, f"{proxy.pod.uid} {proxy.restarts} {image}")


def _delete_pod(
    context: ClusterContext, proxy: ProxyPod, why: str, retire: bool = False
) -> Iterator[Action]:
    """Yield the deletion of a proxy's pod, unless the pod is being deleted already.

    With ``retire`` the proxy first unregisters its nodes. The garbage collector often deletes the
    pod before the operator does. So with ``retire``, also yield the deletion of a pod that is being
    deleted already but still runs.
    """
    node = context.observed.nodes.get(proxy.node)
    runs = serves(proxy) and node is not None and node.ready
    retire = retire and proxy.has_registrations
    useful = not proxy.pod.deleting or (retire and runs)
    if useful and context.retries.is_due(Task(proxy.of, "delete", proxy.pod.id, proxy.pod.uid)):
        yield DeleteProxy(proxy.of, proxy.pod.id, proxy.pod.uid, why, retire)


def _keep_creation_count(context: ClusterContext, place: ProxyPlace) -> None:
    """Keep counting the tries to create a proxy until the proxy serves.

    `Retries` forgets a task that no plan asks for, and with it the count. `note_effect` keeps the
    count while the pod exists. So if no pod of the proxy ever runs, the operator waits longer
    before each further creation (`PROMPT_RECREATIONS`).
    """
    current = context.view.current.get(place)
    if current is None or not serves(current):
        context.retries.note_effect(_creation_task(place))


def _creation_task(place: ProxyPlace) -> Task:
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
    # An unusable RosProxy is not gone. So its Service stays, and its pods keep the address.
    unusable = {r.uid for r in context.observed.unusable.values()}
    for service in context.observed.all_services:
        if service.of not in context.view.rosproxies and service.owner not in unusable:
            yield from _delete_service(context, service, "its RosProxy is gone")


def seconds_to_deadlines(context: ClusterContext) -> Iterator[float]:
    """Yield the seconds until the next plan may differ, although no watch event reports a change.

    These are the ends of graces, the times at which missing nodes count as gone, and the times at
    which the operator gives proxies other ports, because their ports were refused.
    """
    ready = {name for name, node in context.observed.nodes.items() if node.ready}
    yield from (context.grace_left(place) for place in context.state.absent if place.node in ready)
    yield from map(context.seconds_until_lost, context.state.lost)
    yield from (at + REFUSED_RANGE_KEPT_S - context.now for at in context.state.refused.values())
