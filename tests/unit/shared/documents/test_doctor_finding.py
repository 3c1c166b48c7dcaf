"""Findings about names of several graphs."""

from rosproxy.shared.documents.doctor_finding import (
    UNKNOWN_NAME,
    error,
    note,
    ok,
    warning,
    without_known_names,
)


def test_a_name_that_one_proxy_knows_is_unknown_to_none() -> None:
    unknown = error(UNKNOWN_NAME, "proxy b: /scan", "no participant has it")
    connected = ok("pair", "proxy a: /scan from /lidar to /nav", "connected")
    other = warning("node", "proxy b: /scanner", "is slow")
    found = without_known_names([[connected], [unknown, other]], ["/scan"])
    assert found == [connected, other]
    lonely = note("topic", "proxy a: /scan", "no participant subscribes to /scan")
    assert unknown not in without_known_names([[unknown], [lonely]], ["/scan"])


def test_a_name_that_no_proxy_knows_is_told_by_each() -> None:
    unknown = [error(UNKNOWN_NAME, f"proxy {name}: /scan", "no one has it") for name in "ab"]
    about_another = ok("pair", "proxy a: /map from /slam to /nav", "connected")
    found = without_known_names([[unknown[0], about_another], [unknown[1]]], ["/scan", "/map"])
    assert found == [unknown[0], about_another, unknown[1]]
