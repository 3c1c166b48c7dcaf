"""Which of several containers for one thing stays."""

from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.docker.planner.duplicates import IDLE, free_name, select
from rosproxy_operator.docker.planner.model import SERVING, Proxy
from tests.unit.operator.docker.builders import KEY, RANGE, container

STATES = ["running", "paused", "restarting", "created", "exited", "dead", "removing"]
SOME = st.lists(st.tuples(st.sampled_from(STATES), st.booleans()), max_size=4)


def own(name: str, state: str = "running") -> Proxy:
    return Proxy(KEY, container(name, state=state), RANGE, "")


@given(SOME, st.booleans())
def test_everybody_has_one_part(some: list[tuple[str, bool]], creatable: bool) -> None:
    there = [own(f"name-{n}" if n else "name", state) for n, (state, _) in enumerate(some)]
    every = [one.container for one in there]
    right = {one.id for one, (_, is_right) in zip(every, some, strict=True) if is_right}
    found = select(there, "name", right, creatable)
    runs = [one for one in every if one.state in SERVING]
    ready = [one for one in every if one.state in IDLE and one.id in right]
    if any(one.state == "removing" for one in every):
        assert found.waiting
        assert (found.kept is None) == (not runs)
        assert (found.predecessor, found.surplus) == (None, ())
        return
    assert found.stuck == (not runs and not ready and not creatable)
    if found.stuck:
        return
    parts = [one for one in (found.kept, found.predecessor) if one] + list(found.surplus)
    assert sorted(one.name for one in parts) == sorted(one.name for one in every)
    if any(one.id in right for one in runs) or (runs and not creatable):
        assert found.kept in runs
        assert found.predecessor is None
    elif ready:
        assert found.kept in ready
        assert found.predecessor in runs or (found.predecessor is None and not runs)
    else:
        assert found.kept is None
        assert found.predecessor is None or found.predecessor in runs or not runs
    assert not found.predecessor or found.predecessor.state != "dead"


def test_the_one_with_the_name_is_preferred() -> None:
    every = [own(name) for name in ("a", "name", "z")]
    found = select(every, "name", {one.container.id for one in every}, True)
    assert found.kept == every[1].container
    assert [one.name for one in found.surplus] == ["a", "z"]


def test_free_names() -> None:
    assert free_name("a", ()) == "a"
    assert free_name("a", {"a", "a-2"}) == "a-3"
