"""Which of several containers for one thing stays."""

from hypothesis import given
from hypothesis import strategies as st

from rosproxy_operator.docker.planner.model import Container
from rosproxy_operator.docker.planner.selection import IDLE, free_name, select
from tests.unit.operator.docker.builders import container
from tests.unit.operator.docker.simulation import SERVING

STATES = ["running", "paused", "restarting", "created", "exited", "dead", "removing"]
SOME = st.lists(st.tuples(st.sampled_from(STATES), st.booleans(), st.booleans()), max_size=4)


def label(right: bool, usable: bool) -> dict[str, str]:
    return {"right": str(right), "usable": str(usable)}


def is_right(one: Container) -> bool:
    return one.labels["right"] == "True"


def is_usable(one: Container) -> bool:
    return one.labels["usable"] == "True"


@given(SOME, st.booleans())
def test_everybody_has_one_part(some: list[tuple[str, bool, bool]], creatable: bool) -> None:
    every = [
        container(f"name-{n}" if n else "name", label(right, usable), state=state)
        for n, (state, right, usable) in enumerate(some)
    ]
    found = select(every, "name", is_right, is_usable, creatable)
    runs = [one for one in every if one.state in SERVING]
    ready = [one for one in every if one.state in IDLE and is_right(one) and is_usable(one)]
    if any(one.state == "removing" for one in every):
        assert found.waiting
        assert (found.kept is None) == (not runs)
        assert (found.old, found.others) == (None, ())
        return
    assert found.stuck == (not runs and not ready and not creatable)
    if found.stuck:
        return
    parts = [one for one in (found.kept, found.old) if one] + list(found.others)
    assert sorted(one.name for one in parts) == sorted(one.name for one in every)
    if any(is_right(one) for one in runs) or (runs and not creatable):
        assert found.kept in runs
        assert found.old is None
    elif ready:
        assert found.kept in ready
        assert found.old in runs or (found.old is None and not runs)
    else:
        assert found.kept is None
        assert found.old is None or found.old in runs or not runs
    assert found.kept is None or found.kept in runs or is_usable(found.kept)
    assert not found.old or found.old.state != "dead"


def test_the_one_with_the_name_is_preferred() -> None:
    every = [container(name, label(True, True)) for name in ("a", "name", "z")]
    found = select(every, "name", is_right, is_usable, True)
    assert found.kept == every[1]
    assert [one.name for one in found.others] == ["a", "z"]


def test_free_names() -> None:
    assert free_name("a", ()) == "a"
    assert free_name("a", {"a", "a-2"}) == "a-3"
