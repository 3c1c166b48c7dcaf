"""The parameter that outlasts the proxy, at a master that refuses the parameter."""

from types import SimpleNamespace
from typing import Any

import pytest

from rosproxy.ros1.clients.master_client import MasterError
from rosproxy.ros1.upkeep.lease_memory import LeaseMemory
from rosproxy.shared.output.problems import Problems
from tests.unit.builders import add_node, make_addressing


class RefusingMaster:
    """A master without the parameter, which refuses to keep the parameter."""

    async def call_master(self, method: str, *_: object, **__: object) -> object:
        raise MasterError(f"{method} is refused")


@pytest.mark.parametrize("looks", [False, True])
async def test_a_refused_parameter_is_no_problem_once_there_is_nothing_to_keep(
    looks: bool,
) -> None:
    addressing = make_addressing()
    problems = Problems()
    settings = SimpleNamespace(advertise_host="robot", ports=addressing.ports)
    context: Any = SimpleNamespace(
        settings=settings,
        registry=addressing.registry,
        upstream=RefusingMaster(),
        problems=problems,
    )
    memory = LeaseMemory(context)
    endpoint = add_node(addressing)
    await memory.write()
    if looks:  # and finds that the master does not have the parameter
        await memory.look()
    assert [problem.subject for problem in problems.all()] == [memory.parameter]
    addressing.registry.remove(endpoint)
    await memory.write()
    assert problems.all() == []
