"""The metrics of a proxy after the start, and the limit on series."""

import ast
from pathlib import Path

from prometheus_client.exposition import generate_latest

from rosproxy.ros1.registry.client_kinds import ClientKind
from rosproxy.telemetry.metrics import (
    BOUND_REASONS,
    MOST_NAMES,
    RELAY_ERRORS,
    STRANGERS,
    Metrics,
    NamedNodes,
)

ROOT = Path(__file__).resolve().parents[3]
SOURCES = sorted((ROOT / "proxy/rosproxy").rglob("*.py"))


def test_no_series_tells_when_a_counter_began() -> None:
    metrics = Metrics()
    metrics.count("master", "getPid", "ok")
    metrics.master_round_trip.observe(0.1)
    assert b"_created" not in generate_latest(metrics.registry)


def test_what_alerts_count_begins_with_nothing() -> None:
    """Prometheus sees no increase in a series that begins with 1."""
    value = Metrics().registry.get_sample_value
    for reason in BOUND_REASONS:
        assert value("rosproxy_refused_total", {"reason": reason}) == 0
    for reason in RELAY_ERRORS:
        assert value("rosproxy_relay_errors_total", {"reason": reason}) == 0
    for standing in STRANGERS:
        assert value("rosproxy_strangers_total", {"standing": standing}) == 0
    assert {*STRANGERS} == {kind.value for kind in ClientKind} - {"admitted"}


def test_every_reason_is_one_that_the_code_gives() -> None:
    words = {
        node.value
        for path in SOURCES
        if path.name != "metrics.py"
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert {*BOUND_REASONS, *RELAY_ERRORS} <= words
    documented = (ROOT / "docs/reference/metrics.md").read_text()
    assert not [reason for reason in BOUND_REASONS if f"`{reason}`" not in documented]


def test_names_of_nodes_are_bounded() -> None:
    named = NamedNodes()
    assert named.tally(["/a", "/b", "/a"]) == {"/a": 2, "/b": 1}
    for number in range(2 * MOST_NAMES):
        named.tally([f"/anonymous_{number}"])
    assert named.tally(["/a", "/new", "/newer"]) == {"/a": 1, "other": 2}
