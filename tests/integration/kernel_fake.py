"""Fake nft and conntrack, which keep a table like the kernel, and fail on demand."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from rosproxy.forwarding.kernel import plane, syncer
from rosproxy.forwarding.kernel.decisions import HostForwarding
from rosproxy.forwarding.kernel.tools import ToolError, Tools
from rosproxy.shared.addresses import Route

PAIRS = ("marks", "hosts4", "hosts6", "ports", "sources4", "sources6")
OWN = "192.0.2.1"
"""The proxy's address towards all nodes."""


def clear_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the kernel plane find no obstacle in the network namespace."""

    async def nothing(mode: str, tools: Tools) -> None:
        return None

    monkeypatch.setattr(plane, "find_obstacle", nothing)
    monkeypatch.setattr(syncer, "read_forwarding", HostForwarding)
    monkeypatch.setattr(syncer, "route_towards", lambda address: Route(OWN, 1500))


class FakeTools(Tools):
    """A kernel with a single table.

    ``table`` is None without a table. ``flows`` is the output of conntrack, ``counted`` are the
    bytes that nft prints for each mark. The next ``failing`` runs of a program fail. ``lacking`` is
    an expression that the kernel lacks.
    """

    def __init__(self) -> None:
        super().__init__()
        self.table: dict[str, list[Any]] | None = None
        self.name = ""
        self.flows = ""
        self.counted = {"sent": 1000, "received": 1000}
        self.failing = 0
        self.lacking = ""
        self.documents: list[str] = []
        self.forgotten: list[tuple[bool, tuple[str, ...]]] = []

    async def nft(self, *words: str, document: str = "") -> str:
        """The output of nft."""
        self._maybe_fail()
        if "list" in words:
            return self._listed()
        if self.lacking and self.lacking in document:
            raise ToolError("nft: Could not process rule: No such file or directory")
        self.documents.append(document)
        for line in document.splitlines():
            self._apply(line.split(maxsplit=5))
        return ""

    async def list_flows(self, take: Callable[[str], None], ipv6: bool, *which: str) -> None:
        """The output of conntrack."""
        self._maybe_fail()
        take("" if ipv6 else self.flows)

    async def forget_flows(self, ipv6: bool, *which: str) -> None:
        """Note what is to be forgotten."""
        self._maybe_fail()
        self.forgotten.append((ipv6, which))

    @property
    def forwards(self) -> dict[int, tuple[str, int]]:
        """The forwarded ports with their targets."""
        table = self.table or {}
        ports = dict(map(tuple, table.get("ports", [])))
        hosts = [*table.get("hosts4", []), *table.get("hosts6", [])]
        return {port: (host, ports[port]) for port, host in hosts}

    def _maybe_fail(self) -> None:
        if self.failing:
            self.failing -= 1
            raise ToolError("nft: Operation not permitted")

    def _apply(self, words: list[str]) -> None:
        match words:
            case ["table", _, name, "{"]:
                self.name = name
                self.table = {}
            case ["delete", "table", *_]:
                self.table = None
            case ["map" | "set", name, *_] if self.table is not None:
                self.table[name] = []
            case ["flush", "set" | "map", _, _, name] if self.table is not None:
                self.table[name] = []
            case ["add" | "delete" as verb, "element", _, _, name, elements]:
                if self.table is None:
                    raise ToolError("nft: No such file or directory")
                these = [*map(_element, elements.strip("{ }").split(", "))]
                left = [item for item in self.table[name] if item not in these]
                self.table[name] = left + these * (verb == "add")

    def _listed(self) -> str:
        if self.table is None:
            raise ToolError("nft: No such file or directory")
        objects = []
        for name, content in self.table.items():
            kind = "map" if name in PAIRS else "set"
            counts = name in ("sent", "received")
            elements = (
                [_counter(mark, self.counted[name]) for mark in content] if counts else content
            )
            objects.append({kind: {"name": name, "table": self.name, "elem": elements}})
        return json.dumps({"nftables": objects})


def _element(text: str) -> Any:
    """An element in the form of nft, simplified: a number, a network, or a pair."""
    key, _, value = text.partition(" : ")
    if not value:
        return int(key) if key.isdigit() else key
    numbers = (int(part) if part.isdigit() else part for part in (key, value))
    return list(numbers)


def _counter(mark: int, size: int) -> Any:
    return {"elem": {"val": mark, "counter": {"packets": 1, "bytes": size}}}
