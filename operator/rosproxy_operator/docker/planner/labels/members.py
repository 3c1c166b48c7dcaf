"""Read the labels of all containers, and find the members of each proxy."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from itertools import islice

from rosproxy.shared.output.text import listed
from rosproxy_operator.common.problem import (
    MASTER_UNKNOWN,
    NO_ADVERTISE_HOST,
    NOT_ALLOWED,
    NOT_WIRED,
    OPTION_IGNORED,
    UNKNOWN_NAME,
    Fault,
    Problem,
    bounded,
)
from rosproxy_operator.common.ros2 import read_peer_name
from rosproxy_operator.common.spelling import (
    LEAST_SIMILARITY,
    LEAST_SIMILARITY_WITH_PREFIX,
    nearest,
    unknown_name,
)
from rosproxy_operator.docker.planner.labels import bounds, readers, ros_versions
from rosproxy_operator.docker.planner.labels.own_address import wrong_own_address
from rosproxy_operator.docker.planner.labels.readers import (
    ADVERTISE_HOST,
    ENABLE,
    LABELS,
    MASTER_URI,
    REDIRECT,
    ROS,
    NoMaster,
    UnusableLabel,
)
from rosproxy_operator.docker.planner.labels.zenoh import peers_of_one_router, zenoh_member
from rosproxy_operator.docker.planner.model import ALIVE, Container, HostState, Member
from rosproxy_operator.docker.planner.specs import MANAGED, unresolved_master
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.proxy_spec.place import ZENOH, Domain, Master, Place

_PREFIX = "rosproxy"
_CORRECT_LABEL = "Create the container again, with the right label"
# An exited container may start again: the proxy stays on its networks for the grace (`desire`).
_READ_STATES = ALIVE | {"exited"}
"""States of a container in which the operator reads the labels."""
MOST_LABELS = 256
"""Most labels of a container whose spelling is checked. A check takes about 30 µs."""
MOST_UNKNOWN_LABELS = 8
"""Unknown labels of a container that get a warning each. One more warning counts the others."""
MOST_NAME_CHARACTERS = 80
"""Most characters of a label's name in a warning."""


@dataclass(frozen=True, slots=True)
class LabelReading:
    """The requests of all labels, in the order of container names, and the problems of labels.

    The addresses of the masters are unknown here. So a place in ``requests`` has an empty
    ``advertise_host`` if no label or option sets that host. Aliases and redirects of masters are
    still open.
    """

    requests: tuple[Member, ...] = ()
    problems: tuple[Problem, ...] = ()


def read_labels(observed: HostState, settings: PlanSettings) -> LabelReading:
    """Read the labels of all containers.

    A container with an unusable label gets a problem instead of a request, and does not affect
    other containers. Containers that are not alive get no problems.
    """
    proxies = frozenset(own.container.name for own in observed.own)
    requests: list[Member] = []
    problems: list[Problem] = []
    for container in sorted(observed.containers, key=lambda c: (c.name, c.id)):
        if container.state not in _READ_STATES:
            continue
        wrong = [*_warnings(container, settings)]
        try:
            if _is_enabled(container, settings):
                granted, warnings = _requests(container, observed, settings, proxies)
                requests += granted
                wrong += warnings
        except UnusableLabel as error:
            wrong.append(_unusable(container, error.fault, error.reason))
        problems += wrong if container.alive else []
    shared = peers_of_one_router(requests, observed)
    problems += (_warning(container, NOT_WIRED, fault) for container, fault in shared)
    return LabelReading(tuple(requests), tuple(problems))


def master_hosts(reading: LabelReading, observed: HostState) -> tuple[str, ...]:
    """Return the master hosts of all wanted and existing proxies, in lower case, sorted."""
    wanted = {r.place for r in reading.requests if r.container.alive}
    places = (place for place in observed.places | wanted if isinstance(place.graph, Master))
    return tuple(sorted({place.master.host.lower() for place in places}))


def find_members(
    reading: LabelReading, observed: HostState, settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """Return the members of all proxies, and the problems.

    A request without a known advertised host becomes a problem. Other problems are warnings about
    ROS_MASTER_URI, ROS_IP and ROS_HOSTNAME.
    """
    members: list[Member] = []
    problems: list[Problem] = []
    for request in reading.requests:
        container = request.container
        if request.place == ZENOH:
            members.append(request)
            continue
        host = request.place.advertise_host or _advertised(request, observed)
        place = replace(request.place, advertise_host=host)
        if host:
            member, fault = _placed(replace(request, place=place), observed, settings)
            faults = [fault]
            if isinstance(place.graph, Master):
                faults.append(wrong_own_address(container, place, observed))
            wrong = [_warning(container, NOT_WIRED, fault) for fault in faults if fault]
            members.append(member)
        else:
            wrong = [_unusable(container, *_why_no_host(place, observed))]
        problems += wrong if container.alive else []
    return tuple(members), tuple(problems)


def _placed(
    request: Member, observed: HostState, settings: PlanSettings
) -> tuple[Member, Fault | None]:
    """Return the member with the alias or redirect by which nodes find the proxy, and a warning.

    The place of ``request`` is complete.
    """
    container = request.container
    place = request.place
    if not isinstance(place.graph, Master):
        return request, None
    needs, fault = readers.proxy_alias(container, place)
    if not container.master_uri and ros_versions.is_guessed(container):
        fault = None  # the container may be of ROS 2, and has a warning about the unknown version
    by_address = readers.master_by_address(container, place)
    if by_address is None:
        return replace(request, wanted_alias=needs), fault
    internal = {network.name for network in observed.networks if network.internal}
    if not settings.redirect:
        more = "Or start the operator without --no-redirect: the operator then redirects"
    elif request.redirect is False:
        more = f"Or remove {readers.named(REDIRECT, container.labels)}: the operator then redirects"
    # Without a route to the master's address connect(2) fails before the rule takes effect: the
    # kernel looks up the route before the first packet (net/ipv4/tcp_ipv4.c, tcp_v4_connect).
    elif (joined := readers.network_owner(container, observed).networks) and joined <= internal:
        more = (
            "The operator can't redirect the address to the proxy, since all networks of the "
            "container are internal"
        )
        return request, Fault(f"{fault.text}. {more}", fault.fix) if fault else None
    else:
        return replace(request, redirected=(by_address,)), None
    more += " the address to the proxy"
    return request, Fault(fault.text, f"{fault.fix}. {more}") if fault else None


def _why_no_host(place: Place, observed: HostState) -> tuple[Fault, str]:
    """Return why the advertised host is unknown, and the reason of the problem.

    The address of the Docker host depends on the route to the master. So an unknown address of the
    master is the first cause.
    """
    towards = ""
    if isinstance(place.graph, Master):
        host = place.graph.host
        if observed.masters.get(host.lower()) == "":
            text, fix = unresolved_master(host, observed)
            return Fault(f"no address of the master: {text}", fix), MASTER_UNKNOWN
        towards = f" towards the {place.graph}"
    fault = Fault(
        f"the operator does not know this host's address{towards}",
        f"Add the label {ADVERTISE_HOST}=ADDRESS, or start the operator with --advertise-host "
        "ADDRESS",
    )
    return fault, NO_ADVERTISE_HOST


def _requests(
    container: Container, observed: HostState, settings: PlanSettings, proxies: Collection[str]
) -> tuple[list[Member], list[Problem]]:
    """Return a member for each ROS version of a container, within the bounds, and warnings.

    Raises UnusableLabel.
    """
    readers.refuse_long_values(container.labels)
    served = ros_versions.versions(container)
    versions_with_range = sorted(served - {"zenoh"})
    requests = [
        _request(version, container, observed, settings, proxies) for version in versions_with_range
    ]
    granted = [bounds.narrowed(r, settings) for r in requests]
    faults = [*ros_versions.warnings(container, served)]
    for request in requests:
        if isinstance(request.place.graph, Domain):
            faults += ros_versions.static_peer_warnings(container, request.networks, observed)
    refused = dict.fromkeys(fault for _, refusals in granted for fault in refusals)
    members = [request for request, _ in granted]
    if "zenoh" in served:
        member, warnings = zenoh_member(container, observed, settings)
        members.append(member)
        faults += warnings
    return members, [
        *(_warning(container, OPTION_IGNORED, fault) for fault in faults),
        *(_warning(container, NOT_ALLOWED, fault) for fault in refused),
    ]


def _request(
    ros: str,
    container: Container,
    observed: HostState,
    settings: PlanSettings,
    proxies: Collection[str],
) -> Member:
    """Return the request of a container for the nodes of one ROS version, 1 or 2.

    Raises UnusableLabel.
    """
    labels = container.labels
    uri = _master_uri(container, settings, proxies) if ros == "1" else ""
    host = readers.advertise_host(labels, settings)
    if ros == "2":
        ros_versions.refuse_ipv6_host(host)
    networks = readers.networks(container, observed, settings.uplink)
    return Member(
        container,
        Place(Master(uri) if ros == "1" else Domain(ros_versions.domain(container)), host),
        ports=readers.ports(labels),
        networks=networks,
        wishes=readers.wishes(labels, ros, networks, observed.networks),
        policy=readers.policy(labels),
        peers=frozenset(readers.peers(labels, read_peer_name) if ros == "2" else ()),
        redirect=readers.redirect(labels) if ros == "1" else None,
    )


def _master_uri(container: Container, settings: PlanSettings, proxies: Collection[str]) -> str:
    """Return the URI of a container's master. Raises UnusableLabel without a usable master."""
    try:
        return readers.master_uri(container, settings, proxies)
    except NoMaster:
        if not ros_versions.is_guessed(container):
            raise
        raise UnusableLabel(
            ros_versions.UNKNOWN_VERSION,
            f"Add the label {ROS}=2 for ROS 2, or the label {MASTER_URI}=http://HOST:11311 for "
            "ROS 1",
        ) from None


def _warning(container: Container, reason: str, fault: Fault) -> Problem:
    return Problem(f"container {container.name}", *fault, fatal=False, reason=reason)


def _unusable(container: Container, fault: Fault, reason: str) -> Problem:
    """Return a problem, fatal if a label is for the operator: a variable alone is no request."""
    fatal = bool(_labels_for_operator(container))
    return Problem(f"container {container.name}", *fault, fatal=fatal, reason=reason)


def _is_enabled(container: Container, settings: PlanSettings) -> bool:
    """Return whether a container gets a proxy. Raises UnusableLabel."""
    # The other labels of a container with rosproxy.enable=false are not read.
    enabled = readers.enabled(container.labels)
    return _is_exposed(container, settings) if enabled is None else enabled


def _is_exposed(container: Container, settings: PlanSettings) -> bool:
    """Return whether a container without the label rosproxy.enable gets a proxy.

    Raises UnusableLabel.
    """
    if not settings.expose_by_default:
        return False
    has_ros2 = not ros_versions.versions(container) <= {"1"}
    return bool(_labels_for_operator(container) or container.master_uri or has_ros2)


def _labels_for_operator(container: Container) -> list[str]:
    """Return the labels that are meant for this operator, also misspelt labels."""
    prefixed = [name for name in container.labels if name.lower().startswith(f"{_PREFIX}.")]
    # A label without the prefix may belong to another program, so only very similar names count.
    # Labels io.rosproxy.… are the operator's own: io.rosproxy.domain has a similarity of 0.91 to
    # rosproxy.domain, and would count as misspelt.
    others = (name for name in container.labels if not name.startswith(f"io.{_PREFIX}."))
    checked = islice(others, MOST_LABELS)
    near = [name for name in checked if nearest(name, LABELS, LEAST_SIMILARITY)]
    return sorted({*prefixed, *near})


def _warnings(container: Container, settings: PlanSettings) -> Iterator[Problem]:
    """Yield warnings about labels without effect."""
    foreign = ""
    if container.forged:
        foreign = (
            f"has the labels of the operator's own containers, but {container.forged}. An image "
            "can carry such labels, so the operator ignores them"
        )
    elif container.labels.get(MANAGED) == "true":
        foreign = (
            f"has the label {MANAGED}, but not the other labels of the operator's own containers, "
            "so the operator ignores this label"
        )
    if foreign:
        fix = f"Remove the container (docker rm -f {container.name}) or the labels"
        yield _warning(container, OPTION_IGNORED, Fault(foreign, fix))
    own = _labels_for_operator(container)
    if container.labels.get(ENABLE, "").strip().lower() == "false":
        return
    unknown = [name for name in own if name not in LABELS]
    reported = unknown[:MOST_UNKNOWN_LABELS]
    for name in reported:
        near = nearest(name, LABELS, LEAST_SIMILARITY_WITH_PREFIX)
        shown = f"label {bounded(name, MOST_NAME_CHARACTERS)}"
        text = unknown_name(shown, near, ", ".join(LABELS))
        yield _warning(container, UNKNOWN_NAME, Fault(text, _CORRECT_LABEL))
    if left_out := len(unknown) - len(reported):
        text = f"{left_out} more labels {_PREFIX}.… are unknown and ignored"
        yield _warning(container, UNKNOWN_NAME, Fault(text, "Remove these labels"))
    misspelt = any(
        nearest(name, LABELS, LEAST_SIMILARITY_WITH_PREFIX) == ENABLE for name in reported
    )  # warned of above
    if own and not misspelt and ENABLE not in container.labels and not settings.expose_by_default:
        names = listed(f"label {bounded(name, MOST_NAME_CHARACTERS)}" for name in own)
        text = f"{names} ignored, since the label {ENABLE}=true is missing"
        yield _warning(container, OPTION_IGNORED, Fault(text, "Add that label"))


def _advertised(request: Member, observed: HostState) -> str:
    """Return this host's address towards outside, else the advertised host of an existing proxy.

    Outside is the master for ROS 1, and far hosts for ROS 2. The name of the master may not resolve
    for a moment: then the proxy stays. Of several proxies, a proxy on a network of the container
    comes first. Return an empty text if there is neither an address nor a proxy.
    """
    place = request.place
    networks = request.container.networks
    towards = (
        observed.advertise.get(place.graph.host, "")
        if isinstance(place.graph, Master)
        else observed.default_route_address
    )
    sandboxes = [s for s in observed.sandboxes if s.place.graph == place.graph]
    if towards or not sandboxes:
        return towards
    near = {s.place for s in sandboxes if s.container.networks & networks}
    return min(near or {s.place for s in sandboxes}).advertise_host
