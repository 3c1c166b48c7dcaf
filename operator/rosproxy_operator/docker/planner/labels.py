"""From the labels of containers to what they want of a proxy."""

import difflib
from collections.abc import Iterator
from dataclasses import dataclass

from rosproxy.settings import DataPlane
from rosproxy.telemetry.text import listed
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.planner import label_values
from rosproxy_operator.docker.planner.label_values import (
    ADVERTISE_HOST,
    ENABLE,
    LABELS,
    PORTS,
    Unusable,
)
from rosproxy_operator.docker.planner.masters import looks_for, master_uri
from rosproxy_operator.docker.planner.membership import networks
from rosproxy_operator.docker.planner.model import ALIVE, Container, Key, Observed, Wish
from rosproxy_operator.docker.planner.settings import PlanSettings
from rosproxy_operator.docker.planner.specs import MANAGED, master

_PREFIX = "rosproxy"
_COUNTED = ALIVE | {"exited"}


@dataclass(frozen=True, slots=True)
class _Seen:
    """What one container is judged by besides itself."""

    observed: Observed
    settings: PlanSettings
    proxies: frozenset[str]


def read_wishes(
    observed: Observed, settings: PlanSettings
) -> tuple[tuple[Wish, ...], tuple[Problem, ...]]:
    """What the containers want, and what is wrong with what they say, in order of their names.

    A container that can't have what it wants is left out and has a problem, and no other is
    touched by it. Containers that do not run have no problems.
    """
    seen = _seen(observed, settings)
    wishes: list[Wish] = []
    problems: list[Problem] = []
    for container in sorted(observed.containers, key=lambda one: (one.name, one.id)):
        if container.state not in _COUNTED:
            continue
        wish, wrong = _read(container, seen)
        wishes += [wish] if wish else []
        problems += wrong if container.alive else []
    return tuple(wishes), tuple(problems)


def masters(observed: Observed, settings: PlanSettings) -> tuple[str, ...]:
    """The URIs of all masters that a proxy is wanted for or there for, sorted."""
    seen = _seen(observed, settings)
    found = {key.master_uri for key in observed.keys}
    for container in observed.containers:
        try:
            if container.alive and _counts(container, settings):
                found.add(_master(container, seen))
        except Unusable:
            continue  # is told by read_wishes
    return tuple(sorted(found))


def _seen(observed: Observed, settings: PlanSettings) -> _Seen:
    names = frozenset(one.container.name for one in observed.own)
    return _Seen(observed, settings, names)


def _read(container: Container, seen: _Seen) -> tuple[Wish | None, list[Problem]]:
    subject = f"container {container.name}"
    wrong = [Problem(subject, text, fatal=False) for text in _warnings(container, seen.settings)]
    try:
        if not _counts(container, seen.settings):
            return None, wrong
        wish, text = _wish(container, seen)
    except Unusable as error:
        # Nobody has asked for a container that merely has a variable: that is no failure.
        wrong.append(Problem(subject, str(error), fatal=bool(_own(container))))
        return None, wrong
    return wish, wrong + ([Problem(subject, text, fatal=False)] if text else [])


def _wish(container: Container, seen: _Seen) -> tuple[Wish, str]:
    labels = container.labels
    uri = _master(container, seen)
    key = Key(uri, _advertise_host(container, uri, seen))
    needs, text = looks_for(container, key)
    wish = Wish(
        container=container.name,
        id=container.id,
        key=key,
        ports=label_values.count(PORTS, labels[PORTS]) if PORTS in labels else 0,
        networks=networks(
            container, seen.observed, seen.settings.uplink, labels.get(label_values.NETWORK)
        ),
        needs=needs,
        alive=container.alive,
        data_plane=_data_plane(container),
    )
    return wish, text


def _data_plane(container: Container) -> DataPlane | None:
    label = container.labels.get(label_values.DATA_PLANE)
    return None if label is None else label_values.data_plane(label_values.DATA_PLANE, label)


def _counts(container: Container, settings: PlanSettings) -> bool:
    """Whether a container wants a proxy. Raises Unusable if its label says neither."""
    if ENABLE in container.labels:
        return label_values.boolean(ENABLE, container.labels[ENABLE])
    return settings.expose_by_default and bool(_own(container) or container.master_uri)


def _own(container: Container) -> list[str]:
    """The labels that are meant for this controller, misspelt ones too."""
    return sorted(
        name
        for name in container.labels
        if name.lower().startswith(f"{_PREFIX}.")
        or (name.lower().startswith(_PREFIX) and _near(name, 0.9))
    )


def _warnings(container: Container, settings: PlanSettings) -> Iterator[str]:
    if container.labels.get(MANAGED) == "true":
        yield (
            f"has the label {MANAGED}, which is for proxies made by this controller, but not the "
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


def _master(container: Container, seen: _Seen) -> str:
    label = container.labels.get(label_values.MASTER_URI)
    return master_uri(container, label, seen.settings, seen.proxies)


def _advertise_host(container: Container, uri: str, seen: _Seen) -> str:
    label = container.labels.get(ADVERTISE_HOST)
    if label is not None:
        return label_values.host(f"label {ADVERTISE_HOST}={label_values.quoted(label)}", label)
    option = seen.settings.advertise_host
    if option:
        return label_values.host(
            f"the controller's --advertise-host {label_values.quoted(option)}", option
        )
    where = master(Key(uri, ""))
    found = seen.observed.advertise.get(where.host) or _advertised(container, uri, seen.observed)
    if not found:
        raise Unusable(
            f"this host's address towards the master {uri} is not known: add the label "
            f"{ADVERTISE_HOST}=ADDRESS, or start the controller with --advertise-host"
        )
    return found


def _advertised(container: Container, uri: str, observed: Observed) -> str:
    """What a proxy for this master advertises already.

    A name that can't be resolved for a moment must not take a proxy away.
    """
    there = [sandbox for sandbox in observed.sandboxes if sandbox.key.master_uri == uri]
    if not there:
        return ""

    def rank(key: Key) -> tuple[bool, Key]:
        joined = {n for s in there if s.key == key for n in s.container.networks}
        return not joined & container.networks, key

    return min({sandbox.key for sandbox in there}, key=rank).advertise_host
