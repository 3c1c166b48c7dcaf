"""The policy that an operator posts."""

import pytest

from rosproxy.app.policy_sources import PolicySources
from rosproxy.runtime import Runtime
from rosproxy.shared.documents.requests import BodyError
from tests.run_options import parse_settings


async def test_a_refused_policy_is_a_problem_until_the_next_policy() -> None:
    """Fifty later events removed the problem, while the previous policy stayed in force."""
    told = {"master_uri": "http://robot:11311", "advertise_host": "192.0.2.1"}
    runtime = Runtime(parse_settings(told))
    sources = PolicySources(runtime, ())
    for body in ({"layers": "x"}, {"layers": 1}):
        with pytest.raises(BodyError):
            await sources.post(body)
        (problem,) = runtime.problems.all()
        assert problem.text.endswith("The previous policy stays in force")
        assert problem.holds
    await sources.post({"layers": []})
    assert runtime.problems.all() == []
