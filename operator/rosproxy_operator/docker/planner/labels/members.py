"""From the labels of containers to what they want of a proxy."""

import difflib
from collections.abc import Iterator
from dataclasses import dataclass

from rosproxy.settings import DataPlane
from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels import values
from rosproxy_operator.docker.planner.labels.masters import looks_for, master_uri
from rosproxy_operator.docker.planner.labels.networks import networks
from rosproxy_operator.docker.planner.labels.values import (
    ADVERTISE_HOST,
    ENABLE,
    LABELS,
    PORTS,
    UnusableLabel,
)
from rosproxy_operator.docker.planner.model import (
    ALIVE,
    Container,
    HostState,
    Key,
    Member,
    PlanSettings,
)
from rosproxy_operator.docker.planner.specs import MANAGED, master

_PREFIX = "rosproxy"
_COUNTED = ALIVE | {"exited"}


@dataclass(frozen=True, slots=True)
class ProxyRequest:
    """What one container's labels ask for, before it is known where its master is.

    ``advertise_host`` is empty if neither a label nor an option names it, ``ports`` 0 and
    ``data_plane`` None without a label.
    """

    container: Container
    master_uri: str
    advertise_host: str
    ports: int
    networks: frozenset[str]
    data_plane: DataPlane | None


@dataclass(frozen=True, slots=True)
class LabelReading:
    """What all labels ask for, in order of the containers' names, and what is wrong with them."""

    requests: tuple[ProxyRequest, ...] = ()
    problems: tuple[Problem, ...] = ()


def read_labels(observed: HostState, settings: PlanSettings) -> LabelReading:
    """Read the labels of all containers.

    A container that can't have what it wants is left out and has a problem, and no other is
    touched by it. Containers that do not run have no problems.
    """
    proxies = frozenset(one.container.name for one in observed.own)
    requests: list[ProxyRequest] = []
    problems: list[Problem] = []
    for container in sorted(observed.containers, key=lambda one: (one.name, one.id)):
        if container.state not in _COUNTED:
            continue
        wrong = [_problem(container, text, False) for text in _warnings(container, settings)]
        try:
            if _counts(container, settings):
                requests.append(_request(container, observed, settings, proxies))
        except UnusableLabel as error:
            wrong.append(_unusable(container, str(error)))
        problems += wrong if container.alive else []
    return LabelReading(tuple(requests), tuple(problems))


def master_hosts(reading: LabelReading, observed: HostState) -> tuple[str, ...]:
    """The hosts of all masters that a proxy is wanted for or there for, in lower case, sorted."""
    found = {key.master_uri for key in observed.keys}
    found |= {each.master_uri for each in reading.requests if each.container.alive}
    return tuple(sorted({master(Key(uri, "")).host.lower() for uri in found}))


def find_members(
    reading: LabelReading, observed: HostState
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """The containers that belong to a proxy, and those of which it is not known to which."""
    members: list[Member] = []
    problems: list[Problem] = []
    for request in reading.requests:
        container, uri = request.container, request.master_uri
        host = request.advertise_host or _advertised(container, uri, observed)
        if not host:
            text = (
                f"this host's address towards the master {uri} is not known: add the label "
                f"{ADVERTISE_HOST}=ADDRESS, or start the operator with --advertise-host"
            )
            problems += [_unusable(container, text)] if container.alive else []
            continue
        key = Key(uri, host)
        needs, text = looks_for(container, key)
        problems += [_problem(container, text, False)] if text and container.alive else []
        members.append(
            Member(
                container=container.name,
                id=container.id,
                key=key,
                ports=request.ports,
                networks=request.networks,
                needs=needs,
                alive=container.alive,
                data_plane=request.data_plane,
            )
        )
    return tuple(members), tuple(problems)


def _request(
    container: Container, observed: HostState, settings: PlanSettings, proxies: frozenset[str]
) -> ProxyRequest:
    labels = container.labels
    return ProxyRequest(
        container=container,
        master_uri=master_uri(container, labels.get(values.MASTER_URI), settings, proxies),
        advertise_host=_advertise_host(container, settings),
        ports=values.count(PORTS, labels[PORTS]) if PORTS in labels else 0,
        networks=networks(container, observed, settings.uplink, labels.get(values.NETWORK)),
        data_plane=_data_plane(container),
    )


def _problem(container: Container, text: str, fatal: bool) -> Problem:
    return Problem(f"container {container.name}", text, fatal)


def _unusable(container: Container, text: str) -> Problem:
    """Nobody has asked for a container that merely has a variable: that is no failure."""
    return _problem(container, text, fatal=bool(_own(container)))


def _data_plane(container: Container) -> DataPlane | None:
    label = container.labels.get(values.DATA_PLANE)
    return None if label is None else values.data_plane(values.DATA_PLANE, label)


def _counts(container: Container, settings: PlanSettings) -> bool:
    """Whether a container wants a proxy. Raises UnusableLabel if its label says neither."""
    if ENABLE in container.labels:
        return values.boolean(ENABLE, container.labels[ENABLE])
    return settings.expose_by_default and bool(_own(container) or container.master_uri)


def _own(container: Container) -> list[str]:
    """The labels that are meant for this operator, misspelt ones too."""
    return sorted(
        name
        for name in container.labels
        if name.lower().startswith(f"{_PREFIX}.")
        or (name.lower().startswith(_PREFIX) and _near(name, 0.9))
    )


def _warnings(container: Container, settings: PlanSettings) -> Iterator[str]:
    if container.labels.get(MANAGED) == "true":
        yield (
            f"has the label {MANAGED}, which is for proxies made by this operator, but not the "
            f"others that go with it, so it is left alone: docker rm -f {container.name}, or take "
            "the label off"
        )
    own = _own(container)
    if container.labels.get(ENABLE, "").strip().lower() == "false":
        return
    for name in own:
        if name not in LABELS:
            yield f"label {name} is unknown and ignored; {_nearest(name)}"
    if own and ENABLE not in container.labels and not settings.expose_by_default:
        yield f"{listed(f'label {name}' for name in own)} ignored: add the label {ENABLE}=true"


def _nearest(name: str) -> str:
    near = _near(name, 0.75)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(LABELS)}"


def _near(name: str, cutoff: float) -> list[str]:
    return difflib.get_close_matches(name.lower(), LABELS, n=1, cutoff=cutoff)


def _advertise_host(container: Container, settings: PlanSettings) -> str:
    """What the label says, else the option; empty without both. Raises UnusableLabel."""
    label, option = container.labels.get(ADVERTISE_HOST), settings.advertise_host
    if label is not None:
        return values.host(f"label {ADVERTISE_HOST}={values.quoted(label)}", label)
    source = f"the operator's --advertise-host {values.quoted(option)}"
    return values.host(source, option) if option else ""


def _advertised(container: Container, uri: str, observed: HostState) -> str:
    """This host's address towards a master, else what a proxy for it advertises already.

    A name that can't be resolved for a moment must not take a proxy away.
    """
    towards = observed.advertise.get(master(Key(uri, "")).host)
    there = [sandbox for sandbox in observed.sandboxes if sandbox.key.master_uri == uri]
    if towards or not there:
        return towards or ""

    def rank(key: Key) -> tuple[bool, Key]:
        joined = {n for s in there if s.key == key for n in s.container.networks}
        return not joined & container.networks, key

    return min({sandbox.key for sandbox in there}, key=rank).advertise_host
