"""Carrying out what was planned.

Every action may be carried out twice, or after somebody else did it, or on something that has
vanished meanwhile: that is no error, the next look sees what is left to do.
"""

import contextlib
import logging
import secrets
from collections.abc import Iterator

from rosproxy_operator.common.proxy_client import ProxyClient, ProxyError
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker.client import DockerClient, Json
from rosproxy_operator.docker.errors import Conflict, EngineError, Gone
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateNetwork,
    CreateSandbox,
    Disconnect,
    Remove,
    Rename,
    Restart,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.model import PlanSettings
from rosproxy_operator.docker.planner.specs import (
    MANAGED,
    container_config,
    master,
    read_own,
    sandbox_config,
)
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess

log = logging.getLogger(__name__)


class DockerApplier:
    """Carries out actions, each in a thread."""

    def __init__(self, engine: DockerClient, settings: PlanSettings, proxies: ProxyClient) -> None:
        self._engine, self._settings, self._proxies = engine, settings, proxies
        self._former: dict[str, str] = {}

    async def carry_out(self, action: Action, look: DockerSnapshot) -> None:
        """Carry out an action that was planned from a look. Raises EngineError."""
        if isinstance(action, Remove) and action.retire:
            await self._retire(action.name, look.access.get(self._seen_as(action.name, look)))
        await in_thread(self._do, action, look)

    def _seen_as(self, name: str, look: DockerSnapshot) -> str:
        """The name that a container had when the look was made, of one renamed since then."""
        return name if name in look.tokens else self._former.get(name, name)

    async def _retire(self, name: str, access: ProxyAccess | None) -> None:
        if access is None:
            return
        try:
            told = await self._proxies.retire(access.admin, access.token)
            log.info("%s has unregistered %s nodes at its master", name, told.get("unregistered"))
        except ProxyError as error:
            log.warning("%s could not unregister its nodes at the master: %s", name, error)

    def _do(self, action: Action, look: DockerSnapshot) -> None:  # noqa: C901 - one case per action
        engine = self._engine
        match action:
            case CreateNetwork(name):
                with _fine("already exists"):
                    engine.create_network(name, {MANAGED: "true"})
            case CreateSandbox(name):
                self._create(name, sandbox_config(action, self._settings))
            case Create(name):
                self._create(name, self._config(action, look))
            case Start(name):
                with _fine("is not running"):
                    engine.start(name)
            case Restart(name):
                with _fine():
                    engine.restart(name)
            case Unpause(name):
                with _fine("is not paused"):
                    engine.unpause(name)
            case Rename(name, to):
                with _fine("same name as its current name"):
                    engine.rename(name, to)
                self._former[to] = name
            case Connect(name, network, aliases):
                with _fine("already exists in network", "already attached"):
                    engine.connect(name, network, aliases)
            case Disconnect(name, network):
                with _fine("is not connected"):
                    engine.disconnect(name, network)
            case Remove():
                self._remove(action)

    def _remove(self, action: Remove) -> None:
        name = action.name
        try:
            if action.stop:
                self._engine.stop(name)
        except EngineError as error:
            log.debug("%s is killed, as it can't be stopped: %s", name, error)
        with _fine("is already in progress"):
            self._leave_all(name)
            self._engine.remove(name)

    def _leave_all(self, name: str) -> None:
        """Take a container off all networks but the uplink.

        The engine lays the published ports anew over each one that it still has when it ends,
        which takes 2 s per network.
        """
        networks = self._engine.container(name)["NetworkSettings"].get("Networks") or {}
        for network in networks:
            if network != self._settings.uplink:
                with _fine("is not connected"):
                    self._engine.disconnect(name, network)

    def _config(self, made: Create, look: DockerSnapshot) -> Json:
        token = look.tokens.get(self._seen_as(made.replaces, look)) or secrets.token_hex(16)
        address = look.masters.get(master(made.key).host.lower(), "")
        return container_config(made, self._settings, token, address)

    def _create(self, name: str, config: Json) -> None:
        try:
            self._engine.create_container(name, config)
        except Conflict:
            labels = self._engine.container(name)["Config"].get("Labels") or {}
            if read_own(labels) is None:
                raise EngineError(
                    f"a container that is not this operator's is called {name}; "
                    f"rename it (docker rename {name} …) or remove it"
                ) from None


@contextlib.contextmanager
def _fine(*said: str) -> Iterator[None]:
    """Let pass what the engine says when there is nothing left to do, and that things are gone."""
    try:
        yield
    except Gone as error:
        log.debug("gone meanwhile: %s", error)
    except EngineError as error:
        if not any(words in str(error) for words in said):
            raise
        log.debug("nothing to do: %s", error)
