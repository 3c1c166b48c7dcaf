"""From the labels of containers to what they want of a proxy."""

import difflib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner.labels import bounds, values
from rosproxy_operator.docker.planner.labels.values import (
    ADVERTISE_HOST,
    ENABLE,
    LABELS,
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
    proxies = frozenset(one.container.name for one in observed.own)
    requests: list[Member] = []
    problems: list[Problem] = []
    for container in sorted(observed.containers, key=lambda one: (one.name, one.id)):
        if container.state not in _COUNTED:
            continue
        wrong = [_problem(container, text, False) for text in _warnings(container, settings)]
        try:
            if values.enabled(container.labels, _exposed(container, settings)):
                asked = _request(container, observed, settings, proxies)
                request, texts = bounds.narrowed(asked, settings)
                requests.append(request)
                wrong += [_problem(container, text, False) for text in texts]
        except UnusableLabel as error:
            wrong.append(_unusable(container, str(error)))
        problems += wrong if container.alive else []
    return LabelReading(tuple(requests), tuple(problems))


def master_hosts(reading: LabelReading, observed: HostState) -> tuple[str, ...]:
    """The hosts of all masters that a proxy is wanted for or there for, in lower case, sorted."""
    wanted = {each.key for each in reading.requests if each.container.alive}
    return tuple(sorted({master(key).host.lower() for key in observed.keys | wanted}))


def find_members(
    reading: LabelReading, observed: HostState
) -> tuple[tuple[Member, ...], tuple[Problem, ...]]:
    """The containers that belong to a proxy, and those of which it is not known to which."""
    members: list[Member] = []
    problems: list[Problem] = []
    for request in reading.requests:
        container, uri = request.container, request.key.master_uri
        key = Key(uri, request.key.advertise_host or _advertised(request, observed))
        if key.advertise_host:
            needs, text = values.looks_for(container, key)
            wrong = [_problem(container, text, False)] if text else []
            members.append(replace(request, key=key, needs=needs))
        else:
            text = (
                f"this host's address towards the master {uri} is not known: add the label "
                f"{ADVERTISE_HOST}=ADDRESS, or start the operator with --advertise-host"
            )
            wrong = [_unusable(container, text)]
        problems += wrong if container.alive else []
    return tuple(members), tuple(problems)


def _request(
    container: Container, observed: HostState, settings: PlanSettings, proxies: Collection[str]
) -> Member:
    labels, uri = container.labels, values.master_uri(container, settings, proxies)
    networks = values.networks(container, observed, settings.uplink)
    return Member(
        container,
        Key(uri, values.advertise_host(labels, settings)),
        ports=values.ports(labels),
        networks=networks,
        data_plane=values.data_plane(labels),
        direction=values.direction(labels, networks, observed.networks),
        slave_control=values.slave_control(labels),
        policy=values.policy(labels),
    )


def _problem(container: Container, text: str, fatal: bool) -> Problem:
    return Problem(f"container {container.name}", text, fatal)


def _unusable(container: Container, text: str) -> Problem:
    """Nobody has asked for a container that merely has a variable: that is no failure."""
    return _problem(container, text, fatal=bool(_own(container)))


def _exposed(container: Container, settings: PlanSettings) -> bool:
    """Whether a container that does not say gets a proxy."""
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
    if container.forged:
        yield (
            f"has the labels of a container that this operator makes, but {container.forged}: an "
            "image may carry labels, so it is left alone and nothing that they say is believed: "
            f"docker rm -f {container.name}, or take them off"
        )
    elif container.labels.get(MANAGED) == "true":
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
            near = _near(name, 0.75)
            fix = f"did you mean {near[0]}?" if near else f"there are {', '.join(LABELS)}"
            yield f"label {name} is unknown and ignored; {fix}"
    if own and ENABLE not in container.labels and not settings.expose_by_default:
        yield f"{listed(f'label {name}' for name in own)} ignored: add the label {ENABLE}=true"


def _near(name: str, cutoff: float) -> list[str]:
    return difflib.get_close_matches(name.lower(), LABELS, n=1, cutoff=cutoff)


def _advertised(request: Member, observed: HostState) -> str:
    """This host's address towards a master, else what a proxy for it advertises already.

    A name that can't be resolved for a moment must not take a proxy away.
    """
    towards = observed.advertise.get(master(request.key).host, "")
    uri, networks = request.key.master_uri, request.container.networks
    there = [box for box in observed.sandboxes if box.key.master_uri == uri]
    if towards or not there:
        return towards
    near = {box.key for box in there if box.container.networks & networks}
    return min(near or {box.key for box in there}).advertise_host
