"""The choice between several own containers for the same purpose."""

from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.docker.planner.duplicates import IDLE, free_name, select
from rosproxy_operator.docker.planner.model import SERVING, Proxy
from tests.unit.operator.docker.builders import PLACE, RANGE, container

STATES = ["running", "paused", "restarting", "created", "exited", "dead", "removing"]
SOME = st.lists(st.tuples(st.sampled_from(STATES), st.booleans()), max_size=4)


def own(name: str, state: str = "running") -> Proxy:
    return Proxy(PLACE, container(name, state=state), RANGE, "")


@given(SOME, st.booleans())
def test_everybody_has_one_part(some: list[tuple[str, bool]], creatable: bool) -> None:
    proxies = [own(f"name-{n}" if n else "name", state) for n, (state, _) in enumerate(some)]
    every = [proxy.container for proxy in proxies]
    right = {container.id for container, (_, is_right) in zip(every, some, strict=True) if is_right}
    selection = select(proxies, "name", right, creatable)
    runs = [container for container in every if container.state in SERVING]
    ready = [container for container in every if container.state in IDLE and container.id in right]
    if any(container.state == "removing" for container in every):
        assert selection.waiting
        assert (selection.kept is None) == (not runs)
        assert (selection.predecessor, selection.surplus) == (None, ())
        return
    assert selection.stuck == (not runs and not ready and not creatable)
    if selection.stuck:
        return
    assigned = [
        container for container in (selection.kept, selection.predecessor) if container
    ] + list(selection.surplus)
    assert sorted(container.name for container in assigned) == sorted(
        container.name for container in every
    )
    if any(container.id in right for container in runs) or (runs and not creatable):
        assert selection.kept in runs
        assert selection.predecessor is None
    elif ready:
        assert selection.kept in ready
        assert selection.predecessor in runs or (selection.predecessor is None and not runs)
    else:
        assert selection.kept is None
        assert selection.predecessor is None or selection.predecessor in runs or not runs
    assert not selection.predecessor or selection.predecessor.state != "dead"


def test_the_one_with_the_name_is_preferred() -> None:
    every = [own(name) for name in ("a", "name", "z")]
    selection = select(every, "name", {proxy.container.id for proxy in every}, True)
    assert selection.kept == every[1].container
    assert [container.name for container in selection.surplus] == ["a", "z"]


def test_free_names() -> None:
    assert free_name("a", ()) == "a"
    assert free_name("a", {"a", "a-2"}) == "a-3"
