"""From the labels of containers to what they want of a proxy."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from itertools import islice

from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem, bounded
from rosproxy_operator.common.spelling import NEAR, VERY_NEAR, nearest
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
from rosproxy_operator.docker.planner.labels.zenoh import zenoh_member
from rosproxy_operator.docker.planner.model import ALIVE, ZENOH, Container, HostState, Key, Member
from rosproxy_operator.docker.planner.specs import MANAGED, master, unresolved_master
from rosproxy_operator.docker.settings import PlanSettings

_PREFIX = "rosproxy"
# One that has exited may come back: for the grace its proxy stays on its networks (see `desire`).
_COUNTED = ALIVE | {"exited"}
MOST_LABELS = 256
"""Labels of a container whose spelling is checked: each check takes some 30 microseconds."""
MOST_UNKNOWN = 8
"""Unknown labels of a container that are told one by one; the others are counted."""
LONGEST_NAME = 80
"""Characters of a label's name that are told."""


@dataclass(frozen=True, slots=True)
class LabelReading:
    """What all labels ask for, in order of the containers' names, and what is wrong with them.

    It is not known yet where the masters are: the keys of ``requests`` have an empty
    ``advertise_host`` where neither a label nor an option names it, and what they need is open.
    """

    requests: tuple[Member, ...] = ()
    problems: tuple[Problem, ...] = ()


def read_labels(observed: HostState, settings: PlanSettings) -> LabelReading:
    """Read the labels of all containers.

    A container that can't have what it wants is left out and has a problem, and no other is
    touched by it. Containers that do not run have no problems.
    """
    proxies = frozenset(own.container.name for own in observed.own)
    requests: list[Member] = []
    problems: list[Problem] = []
    for container in sorted(observed.containers, key=lambda c: (c.name, c.id)):
        if container.state not in _COUNTED:
            continue
        wrong = [_problem(container, text, False) for text in _warnings(container, settings)]
        try:
            if readers.enabled(container.labels, _exposed(container, settings)):
                granted, texts = _requests(container, observed, settings, proxies)
                requests += granted
                wrong += [_problem(container, text, False) for text in texts]
        except UnusableLabel as error:
            wrong.append(_unusable(container, str(error)))
        problems += wrong if container.alive else []
    return LabelReading(tuple(requests), tuple(problems))


def master_hosts(reading: LabelReading, observed: HostState) -> tuple[str, ...]:
    """The hosts of all masters that a proxy is wanted for or there for, in lower case, sorted."""
    wanted = {r.key for r in reading.requests if r.container.alive}
    keys = (key for key in observed.keys | wanted if key.ros == "1")
    return tuple(sorted({master(key).host.lower() for key in keys}))


def find_members(
    reading: LabelReading, observed: HostState, settings: PlanSettings
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """The containers that belong to a proxy, and problems of those whose proxy is not known."""
    members: list[Member] = []
    problems: list[Problem] = []
    for request in reading.requests:
        container = request.container
        if request.key == ZENOH:
            members.append(request)
            continue
        host = request.key.advertise_host or _advertised(request, observed)
        key = replace(request.key, advertise_host=host)
        if host:
            member, text = _placed(replace(request, key=key), observed, settings)
            texts = [text, "" if key.is_ros2 else wrong_own_address(container, key, observed)]
            wrong = [_problem(container, text, False) for text in texts if text]
            members.append(member)
        else:
            text = _why_no_host(key, observed)
            wrong = [_unusable(container, text)]
        problems += wrong if container.alive else []
    return tuple(members), tuple(problems)


def _placed(request: Member, observed: HostState, settings: PlanSettings) -> tuple[Member, str]:
    """A container whose key is known, with how its nodes find the proxy, and a warning."""
    container = request.container
    key = request.key
    if key.is_ros2:
        return request, ""
    needs, text = readers.proxy_alias(container, key)
    if not container.master_uri and ros_versions.is_guessed(container):
        text = ""  # it may be of ROS 2: first its version has to be known
    by_address = readers.master_by_address(container, key)
    if by_address is None:
        return replace(request, wanted_alias=needs), text
    internal = {network.name for network in observed.networks if network.internal}
    if not settings.redirect:
        text += (
            ". Or start the operator without --no-redirect: the operator then redirects the "
            "address to the proxy"
        )
    elif request.redirect is False:
        text += (
            f". Or remove {readers.named(REDIRECT, container.labels)}: the operator then redirects "
            "the address to the proxy"
        )
    # Without a route to the master's address connect(2) fails before the rule could take effect:
    # the kernel looks for a route before there is a packet (net/ipv4/tcp_ipv4.c, tcp_v4_connect).
    elif (joined := readers.network_owner(container, observed).networks) and joined <= internal:
        text += (
            ". The operator can't redirect the address to the proxy, since all networks of the "
            "container are internal"
        )
    else:
        return replace(request, redirected=(by_address,)), ""
    return request, text


def _why_no_host(key: Key, observed: HostState) -> str:
    """Why it is not known how outside reaches this host, the first cause first.

    It follows from the master's address, which often is what is not known.
    """
    if not key.is_ros2 and observed.masters.get(master(key).host.lower()) == "":
        return f"no address of the master: {unresolved_master(master(key).host)}"
    towards = "" if key.is_ros2 else f" towards the {key.graph}"
    return (
        f"the operator does not know this host's address{towards}. Add the label "
        f"{ADVERTISE_HOST}=ADDRESS, or start the operator with --advertise-host ADDRESS"
    )


def _requests(
    container: Container, observed: HostState, settings: PlanSettings, proxies: Collection[str]
) -> tuple[list[Member], list[str]]:
    """What a container gets of what it asks for, by version of ROS, and the warnings for it."""
    readers.refuse_long_values(container.labels)
    served = ros_versions.versions(container)
    of_range = sorted(served - {"zenoh"})
    requests = [_request(r, container, observed, settings, proxies) for r in of_range]
    granted = [bounds.narrowed(r, settings) for r in requests]
    warnings = [*ros_versions.warnings(container, served)]
    for request in requests:
        if request.key.is_ros2:
            warnings += ros_versions.past_the_proxy(container, request.networks, observed)
    warnings += dict.fromkeys(text for _, texts in granted for text in texts)
    members = [request for request, _ in granted]
    if "zenoh" in served:
        member, texts = zenoh_member(container, observed, settings)
        members.append(member)
        warnings += texts
    return members, warnings


def _request(
    ros: str,
    container: Container,
    observed: HostState,
    settings: PlanSettings,
    proxies: Collection[str],
) -> Member:
    """What a container asks for, for its nodes of one version of ROS."""
    labels = container.labels
    is_ros2 = ros == "2"
    uri = "" if is_ros2 else _master_uri(container, settings, proxies)
    host = readers.advertise_host(labels, settings)
    if is_ros2:
        ros_versions.refuse_unserved(host)
    networks = readers.networks(container, observed, settings.uplink)
    return Member(
        container,
        Key(uri, host, ros_versions.domain(container) if is_ros2 else None),
        ports=readers.ports(labels),
        networks=networks,
        wishes=readers.wishes(labels, ros, networks, observed.networks),
        policy=readers.policy(labels),
        peers=ros_versions.peers(labels) if is_ros2 else frozenset(),
        redirect=None if is_ros2 else readers.redirect(labels),
    )


def _master_uri(container: Container, settings: PlanSettings, proxies: Collection[str]) -> str:
    """The URI of a container's master. Raises UnusableLabel if it has none."""
    try:
        return readers.master_uri(container, settings, proxies)
    except NoMaster:
        if not ros_versions.is_guessed(container):
            raise
        raise UnusableLabel(
            f"{ros_versions.UNKNOWN}. Add the label {ROS}=2 for ROS 2, or the label "
            f"{MASTER_URI}=http://HOST:11311 for ROS 1"
        ) from None


def _problem(container: Container, text: str, fatal: bool) -> Problem:
    return Problem(f"container {container.name}", text, fatal)


def _unusable(container: Container, text: str) -> Problem:
    """A failure only if a label asks for a proxy; a mere variable is no request."""
    return _problem(container, text, fatal=bool(_own(container)))


def _exposed(container: Container, settings: PlanSettings) -> bool:
    """Whether a container that does not say gets a proxy."""
    if not settings.expose_by_default:
        return False
    is_ros2 = not ros_versions.versions(container) <= {"1"}
    return bool(_own(container) or container.master_uri or is_ros2)


def _own(container: Container) -> list[str]:
    """The labels that are meant for this operator, misspelt ones too."""
    prefixed = [name for name in container.labels if name.lower().startswith(f"{_PREFIX}.")]
    # Without the prefix only a name that is very near counts, as it may be another program's.
    # io.rosproxy.domain, the operator's own, is 0.91 near to rosproxy.domain.
    others = (name for name in container.labels if not name.startswith(f"io.{_PREFIX}."))
    checked = islice(others, MOST_LABELS)
    near = [name for name in checked if nearest(name, LABELS, VERY_NEAR)]
    return sorted({*prefixed, *near})


def _warnings(container: Container, settings: PlanSettings) -> Iterator[str]:
    if container.forged:
        yield (
            f"has the labels of the operator's own containers, but {container.forged}. An image "
            "can carry such labels, so the operator ignores them. Remove the container (docker rm "
            f"-f {container.name}) or the labels"
        )
    elif container.labels.get(MANAGED) == "true":
        yield (
            f"has the label {MANAGED}, but not the other labels of the operator's own containers, "
            "so the operator ignores this label. Remove the container (docker rm -f "
            f"{container.name}) or the label"
        )
    own = _own(container)
    if container.labels.get(ENABLE, "").strip().lower() == "false":
        return
    unknown = [name for name in own if name not in LABELS]
    told = unknown[:MOST_UNKNOWN]
    for name in told:
        near = nearest(name, LABELS, NEAR)
        fix = f"Did you mean {near}?" if near else f"Known labels: {', '.join(LABELS)}"
        yield f"label {bounded(name, LONGEST_NAME)} is unknown and ignored. {fix}"
    if left_out := len(unknown) - len(told):
        yield f"{left_out} more labels {_PREFIX}.… are unknown and ignored. Remove these labels"
    misspelt = any(nearest(name, LABELS, NEAR) == ENABLE for name in told)  # warned of above
    if own and not misspelt and ENABLE not in container.labels and not settings.expose_by_default:
        names = listed(f"label {bounded(name, LONGEST_NAME)}" for name in own)
        yield f"{names} ignored, since the label {ENABLE}=true is missing. Add that label"


def _advertised(request: Member, observed: HostState) -> str:
    """This host's address towards a master, else what a proxy for it advertises already.

    A name that can't be resolved for a moment must not take a proxy away.
    """
    key = request.key
    networks = request.container.networks
    towards = observed.far if key.is_ros2 else observed.advertise.get(master(key).host, "")
    sandboxes = [
        s
        for s in observed.sandboxes
        if (s.key.master_uri, s.key.domain) == (key.master_uri, key.domain)
    ]
    if towards or not sandboxes:
        return towards
    near = {s.key for s in sandboxes if s.container.networks & networks}
    return min(near or {s.key for s in sandboxes}).advertise_host
