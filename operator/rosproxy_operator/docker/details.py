"""What only an inspection tells of a container, asked once per container and kept.

The engine's list has states, labels, addresses and networks, and answers in milliseconds whatever
happens. An inspection waits until the container's start is over, which takes 26 s with 1000 ports
to publish. Nothing that is read from it changes but the aliases, and those only with the
endpoints, whose ids are in the list.
"""

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.errors import EngineError, Gone
from rosproxy_operator.docker.planner.specs import TOKEN_VARIABLE

log = logging.getLogger(__name__)

PATIENCE = 0.1
"""Seconds that a look waits for inspections; later ones count from the next look on."""
AT_ONCE = 16
_NEVER = "0001-"


@dataclass(frozen=True, slots=True)
class Details:
    """Of a container: ``host_ports`` it asks for, ``aliases`` by network, ``token`` if ours.

    ``state`` is in the engine's words, ``started_at`` empty if it was never started.
    """

    master_uri: str = ""
    hostname: str = ""
    host_ports: frozenset[int] = frozenset()
    aliases: Mapping[str, frozenset[str]] = field(default_factory=dict)
    token: str = ""
    state: str = ""
    started_at: str = ""


def read_details(inspected: Json) -> Details:
    """The details in what the engine tells of a container."""
    config = inspected.get("Config") or {}
    variables = dict(text.partition("=")[::2] for text in config.get("Env") or ())
    networks = (inspected.get("NetworkSettings") or {}).get("Networks") or {}
    state = inspected.get("State") or {}
    started = state.get("StartedAt") or ""
    return Details(
        master_uri=variables.get("ROS_MASTER_URI", ""),
        hostname=config.get("Hostname") or "",
        host_ports=bound_ports((inspected.get("HostConfig") or {}).get("PortBindings")),
        aliases={name: _aliases(endpoint or {}) for name, endpoint in networks.items()},
        token=variables.get(TOKEN_VARIABLE, ""),
        state=state.get("Status") or "",
        started_at="" if started.startswith(_NEVER) else started,
    )


def bound_ports(bindings: Json | None) -> frozenset[int]:
    """The TCP ports of the host that port bindings name; all of a range, of which one is chosen."""
    return frozenset(
        port
        for key, wanted in (bindings or {}).items()
        if key.endswith("/tcp") or "/" not in key
        for binding in wanted or ()
        for port in _host_ports(binding.get("HostPort") or "")
    )


def signature(row: Json) -> tuple[tuple[str, str], ...]:
    """What of a container's row in the list changes whenever its aliases may have changed."""
    networks = (row.get("NetworkSettings") or {}).get("Networks") or {}
    return tuple(
        sorted((name, (end or {}).get("EndpointID") or "") for name, end in networks.items())
    )


class Inspector:
    """Keeps the details of all containers. ``late`` is called when some come after a look."""

    def __init__(self, engine: DockerClient, late: Callable[[], None]) -> None:
        self._engine, self._late = engine, late
        self._known: dict[str, tuple[Any, Details]] = {}
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._marks: dict[str, object] = {}
        self._turns = asyncio.Semaphore(AT_ONCE)

    @property
    def waiting(self) -> bool:
        """Whether inspections are under way, which are going to be told."""
        return bool(self._asking)

    def get(self, container: str) -> Details | None:
        """The last known details of a container, by id; None if there are none yet."""
        known = self._known.get(container)
        return known[1] if known else None

    def fresh(self, container: str) -> bool:
        """Whether a container's details are those of the state in which the list showed it."""
        known = self._known.get(container)
        return known is not None and known[0] == self._marks.get(container)

    async def update(
        self, rows: Iterable[Json], always: Collection[str] = (), patience: float = PATIENCE
    ) -> None:
        """Inspect what is new or has changed among the containers in the list.

        ``always`` are the ids of those that may have been started anew without a trace in the list.
        """
        self._marks = {
            row["Id"]: object() if row["Id"] in always else signature(row) for row in rows
        }
        self._known = {key: known for key, known in self._known.items() if key in self._marks}
        asked = []
        for key, mark in self._marks.items():
            if key not in self._asking and not self.fresh(key):
                self._asking[key] = asyncio.create_task(self._inspect(key, mark))
                asked.append(self._asking[key])
        if asked:
            _, late = await asyncio.wait(asked, timeout=patience)
            for task in late:
                task.add_done_callback(lambda _: self._late())

    async def _inspect(self, container: str, mark: object) -> None:
        try:
            async with self._turns:
                inspected = await in_thread(self._engine.container, container)
            self._known[container] = mark, read_details(inspected)
        except Gone:
            pass
        except EngineError as error:
            log.debug("inspecting %s: %s", container[:12], error)
        finally:
            del self._asking[container]


def _aliases(endpoint: Json) -> frozenset[str]:
    """All names of an endpoint: engines since 25 list the container's own under DNSNames."""
    return frozenset(endpoint.get("Aliases") or ()) | frozenset(endpoint.get("DNSNames") or ())


def _host_ports(text: str) -> range:
    """``8000``, ``8000-8010``; none for an empty text or 0, which let the engine choose."""
    first, _, last = text.partition("-")
    if not first.isdecimal() or not (last or first).isdecimal() or int(first) == 0:
        return range(0)
    return range(int(first), int(last or first) + 1)
