"""nft and conntrack of a test: they keep one table as the kernel would, and fail when told to."""

import json
from typing import Any

from rosproxy.forwarding.kernel.tools import ToolError, Tools

PAIRS = ("marks", "hosts4", "hosts6", "ports")


class FakeTools(Tools):
    """A kernel with one table.

    ``table`` is None where there is none; ``flows`` is what conntrack prints. The next runs of a
    program fail as often as ``failing`` says.
    """

    def __init__(self) -> None:
        super().__init__()
        self.table: dict[str, list[Any]] | None = None
        self.name = ""
        self.flows = ""
        self.failing = 0
        self.documents: list[str] = []
        self.forgotten: list[tuple[str, bool, str]] = []

    async def nft(self, *words: str, document: str = "") -> str:
        """What ``nft -j`` prints."""
        self._maybe_fail()
        if words[0] == "list":
            return self._listed()
        self.documents.append(document)
        for command in json.loads(document)["nftables"]:
            for verb, rest in command.items():
                for kind, body in rest.items():
                    self._apply(verb, kind, body)
        return ""

    async def list_flows(self, mark: str, ipv6: bool) -> str:
        """What conntrack prints."""
        self._maybe_fail()
        return "" if ipv6 else self.flows

    async def forget_flows(self, mark: str, ipv6: bool, state: str = "") -> None:
        """Note what is to be forgotten."""
        self._maybe_fail()
        self.forgotten.append((mark, ipv6, state))

    @property
    def forwards(self) -> dict[int, tuple[str, int]]:
        """The ports with the addresses and ports that they lead to."""
        table = self.table or {}
        ports = dict(map(tuple, table.get("ports", [])))
        hosts = [*table.get("hosts4", []), *table.get("hosts6", [])]
        return {port: (host, ports[port]) for port, host in hosts}

    def _maybe_fail(self) -> None:
        if self.failing:
            self.failing -= 1
            raise ToolError("nft: Operation not permitted")

    def _apply(self, verb: str, kind: str, body: Any) -> None:
        if kind == "table":
            self.name = body["name"]
            self.table = None if verb == "delete" else self.table or {}
        elif self.table is None:
            raise ToolError("nft: No such file or directory")
        elif kind in ("map", "set"):
            self.table[body["name"]] = []
        elif kind == "element":
            held = self.table[body["name"]]
            for item in body["elem"]:
                if verb == "delete":
                    held.remove(item)
                elif item not in held:
                    held.append(item)

    def _listed(self) -> str:
        if self.table is None:
            raise ToolError("nft: No such file or directory")
        objects = []
        for name, held in self.table.items():
            kind = "map" if name in PAIRS else "set"
            elements = held if kind == "map" else [_counter(mark) for mark in held]
            objects.append({kind: {"name": name, "table": self.name, "elem": elements}})
        return json.dumps({"nftables": objects})


def _counter(mark: int) -> Any:
    return {"elem": {"val": mark, "counter": {"packets": 1, "bytes": 1000}}}
