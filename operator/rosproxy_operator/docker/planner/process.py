"""What is to be done for the container in which a proxy runs, in its sandbox's namespace."""

from collections.abc import Collection, Iterator

from rosproxy_operator.docker.planner.actions import (
    Action,
    Create,
    ProxySpec,
    Remove,
    Rename,
    Restart,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.context import (
    PlanContext,
    former_name,
    lives_in,
    named,
    removed,
)
from rosproxy_operator.docker.planner.model import STARTED, Container, Proxy, Sandbox
from rosproxy_operator.docker.planner.sandbox import Home
from rosproxy_operator.docker.planner.selection import Selection, free_name, select
from rosproxy_operator.docker.planner.specs import proxy_fingerprint, proxy_name
from rosproxy_operator.docker.planner.state import SERVING


def process_steps(
    context: PlanContext, home: Home, gone: Collection[str]
) -> tuple[Action, ...] | None:
    """The next actions for the proxy of a key that is wanted.

    ``gone`` are the names of containers that are removed before. None if one ought to be created
    but can't.
    """
    image, plane = context.observed.image_id, context.desired.data_plane
    expected = proxy_fingerprint(context.key, context.ports, context.settings, image, plane)
    there = [one for one in context.proxies if one.container.name not in gone]
    right = {
        one.container.id
        for one in there
        if lives_in(one.container, home.id)
        and one.range == context.ports
        and (not context.creatable or one.fingerprint == expected)
    }
    found = select(
        (one.container for one in there),
        proxy_name(context.key),
        right=lambda container: container.id in right,
        usable=lambda container: True,
        creatable=context.creatable,
    )
    misplaced = found.kept and not lives_in(found.kept, home.id)
    if found.waiting and (misplaced or not found.kept):
        return ()
    if found.stuck or misplaced:
        return None
    if found.kept:
        return tuple(_tended(context, found, found.kept, home))
    before = [one.container.name for one in context.proxies if one.container.name in gone]
    return tuple(_created(context, found, home, expected, before[0] if before else ""))


def retired(sandboxes: Collection[Sandbox], proxies: Collection[Proxy]) -> Iterator[Action]:
    """Remove everything of a key that nobody wants any more."""
    why = "no running container wants it any more"
    for one in proxies:
        if one.container.state == "paused":
            yield Unpause(one.container.name)
        yield Remove(one.container.name, why, retire=one.container.state in STARTED)
    yield from removed(tuple(one.container for one in sandboxes), why)


def instant(text: str) -> tuple[str, str]:
    """A time in the engine's words, so that it can be compared: their fractions vary in length."""
    seconds, _, fraction = text.removesuffix("Z").partition(".")
    return seconds, fraction.ljust(9, "0")


def _tended(
    context: PlanContext, found: Selection, kept: Container, home: Home
) -> Iterator[Action]:
    if found.waiting:
        if kept.state == "paused":
            yield Unpause(kept.name)
        return
    yield from removed(found.others, "left over")
    if found.old:
        yield from removed((found.old,), "another one takes over")
    if kept.state not in SERVING:
        yield Start(kept.name)
    elif kept.state == "paused":
        yield Unpause(kept.name)
    if kept.state in SERVING and _lost(kept, home):
        yield Restart(kept.name)
    yield from named(kept, proxy_name(context.key), _others(context))


def _lost(kept: Container, home: Home) -> bool:
    """Whether a proxy runs in the namespace that its sandbox had before it was started anew."""
    if home.starts:
        return True
    if not kept.started_at or not home.started_at or kept.state == "restarting":
        return False
    return instant(kept.started_at) < instant(home.started_at)


def _created(
    context: PlanContext, found: Selection, home: Home, expected: str, before: str
) -> Iterator[Action]:
    """Create a proxy, in the place of an old one, if any; or of one that is removed ``before``."""
    yield from removed(found.others, "left over")
    name = free_name(proxy_name(context.key), _others(context))
    old = found.old
    former = former_name(old.name, name, _others(context)) if old else ""
    if old and former != old.name:
        yield Rename(old.name, former)
    replaces = former or before
    plane = context.desired.data_plane
    yield Create(ProxySpec(name, context.key, context.ports, expected, home.name, replaces, plane))
    if old:
        yield Remove(former, "made anew")
    yield Start(name)


def _others(context: PlanContext) -> frozenset[str]:
    return context.taken(tuple(one.container for one in context.proxies))
