"""Containers with any text in labels, variables, names: no traceback, no forged line of a log."""

import json
import logging
from collections.abc import Iterator
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rosproxy.shared.output.logs import JsonLines, TextLines
from rosproxy_operator.docker.engine_json import check_inspection, read_container
from rosproxy_operator.docker.host_document import host_document
from rosproxy_operator.docker.planner.actions import Create, CreateSandbox
from rosproxy_operator.docker.planner.labels.readers import LABELS
from rosproxy_operator.docker.planner.model import HostState
from rosproxy_operator.docker.planner.plan import DockerPlan
from rosproxy_operator.docker.planner.report import render
from rosproxy_operator.docker.planner.specs import (
    MANAGED,
    MASTER_URI,
    RANGE,
    ROLE,
    container_config,
    sandbox_config,
)
from rosproxy_operator.docker.planner.state import DockerMemory
from tests.unit.operator.docker import captured
from tests.unit.operator.docker.builders import (
    APP,
    SECRET,
    SETTINGS,
    container,
    observed,
    planned,
)

LONGEST_PROBLEM = 1500
"""Characters: the most that a problem has is some quoted values, of 80 characters each."""
# Half a character of UTF-16, too: JSON can have that, and UTF-8 can't.
ANY_TEXT = st.text(st.characters(exclude_categories=()), max_size=30)
USUAL = st.sampled_from(
    [
        *("true", "1", "2", "1,2", "0", "both", "kernel", "robot", "192.0.2.7"),
        *("http://robot:11311", "deny publish /a", "\x1b[2J", "\ud800"),
        "a\n2026-01-01 00:00:00,000 ERROR   the robot is on fire",
    ]
)
VALUES = st.one_of(USUAL, ANY_TEXT, st.tuples(USUAL, ANY_TEXT).map("".join))
NAMES = st.one_of(
    st.sampled_from([*LABELS, MANAGED, ROLE, MASTER_URI, RANGE]),
    ANY_TEXT,
    ANY_TEXT.map("rosproxy.{}".format),
)
VARIABLES = st.sampled_from(
    [
        *("ROS_MASTER_URI", "ROS_VERSION", "ROS_DISTRO", "ROS_DOMAIN_ID", "ROS_IP"),
        *("ROS_HOSTNAME", "ROS_LOCALHOST_ONLY", "RMW_IMPLEMENTATION"),
    ]
)


def host(labels: dict[str, str], variables: dict[str, str], name: str, alias: str) -> HostState:
    """A host with such a container, and with another container with the same ROS_MASTER_URI."""
    config = {
        "Env": [f"{variable}={value}" for variable, value in variables.items()],
        "User": alias,
        "Cmd": [alias],
        "Hostname": alias,
    }
    networks = {"Networks": {"app": {"Aliases": [alias]}}}
    inspection = {**captured.inspected(), "Config": config, "NetworkSettings": networks}
    row: dict[str, Any] = captured.running() | {
        "Labels": {"rosproxy.enable": "true", **labels},
        "Names": [f"/{name}"],
    }
    hostile = read_container(row, check_inspection(inspection), [APP])
    labelled = {"rosproxy.enable": "true"}
    other = container("other", labelled, env=variables.get("ROS_MASTER_URI", ""))
    return observed(hostile, other)


def log_lines(plan: DockerPlan) -> Iterator[str]:
    """The log lines of a plan."""
    for form in (TextLines(), JsonLines()):
        for action in plan.actions:
            yield form.format(record(action.log_fields, "%s", action))
        for problem in plan.problems:
            yield form.format(
                record(problem.log_fields, "%s: %s", problem.subject, problem.message)
            )


def record(fields: dict[str, str], message: str, *arguments: object) -> logging.LogRecord:
    logger = logging.getLogger("rosproxy.test")
    level = logging.WARNING
    return logger.makeRecord(logger.name, level, "f", 1, message, arguments, None, extra=fields)


@given(
    st.dictionaries(NAMES, VALUES, max_size=6),
    st.dictionaries(VARIABLES, VALUES, max_size=4),
    ANY_TEXT,
    ANY_TEXT,
)
def test_no_text_of_a_container_gets_further_than_its_place(
    labels: dict[str, str], variables: dict[str, str], name: str, alias: str
) -> None:
    seen = host(labels, variables, name, alias)
    plan = planned(seen, SETTINGS, DockerMemory(), 0.0)
    for line in log_lines(plan):
        assert line.isprintable()
        assert line.encode()
    for problem in plan.problems:
        assert len(problem.message) < LONGEST_PROBLEM
    document = {**host_document(seen, plan, plan.problems, {}, SETTINGS, 0.0), "operator": None}
    assert json.dumps(document).isascii()
    assert all(line.isprintable() for line in render(document, 80).split("\n"))
    # What the engine is sent is UTF-8.
    for action in plan.actions:
        if isinstance(action, CreateSandbox):
            assert json.dumps(sandbox_config(action, SETTINGS), ensure_ascii=False).encode()
        if isinstance(action, Create):
            config = container_config(action, SETTINGS, SECRET, "")
            assert json.dumps(config, ensure_ascii=False).encode()
