"""Carrying out what was planned.

Every action may be carried out twice, or after somebody else did it, or on something that has
vanished meanwhile: that is no error, the next look sees what is left to do.
"""

import logging
import secrets

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
    read_own,
    sandbox_config,
)
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess

log = logging.getLogger(__name__)

STOP_TIMEOUT = 2
"""Seconds that a process has to end before it is killed."""
DONE: dict[type, tuple[str, ...]] = {
    CreateNetwork: ("already exists",),
    Start: ("is not running",),
    Restart: (),
    Unpause: ("is not paused",),
    Rename: ("same name as its current name",),
    Connect: ("already exists in network", "already attached"),
    Disconnect: ("is not connected",),
    Remove: ("is already in progress",),
}
"""What the engine says when there is nothing left to do; nor is there for what is gone."""


class DockerApplier:
    """Carries out actions, each in a thread."""

    def __init__(self, engine: DockerClient, settings: PlanSettings, proxies: ProxyClient) -> None:
        self._engine, self._settings, self._proxies = engine, settings, proxies

    async def carry_out(self, action: Action, look: DockerSnapshot) -> None:
        """Carry out an action that was planned from a look. Raises EngineError."""
        if isinstance(action, Remove) and action.retire and action.name in look.access:
            await self._retire(action.name, look.access[action.name])
        await in_thread(self._do, action, look)

    async def _retire(self, name: str, access: ProxyAccess) -> None:
        try:
            told = await self._proxies.retire(access.admin, access.token)
            log.info("%s has unregistered %s nodes at its master", name, told.get("unregistered"))
        except ProxyError as error:
            log.warning("%s could not unregister its nodes at the master: %s", name, error)

    def _do(self, action: Action, look: DockerSnapshot) -> None:
        try:
            self._call(action, look)
        except EngineError as error:
            done = DONE.get(type(action))
            if done is None or not (
                isinstance(error, Gone) or any(words in str(error) for words in done)
            ):
                raise
            log.debug("nothing left to do: %s", error)

    def _call(self, action: Action, look: DockerSnapshot) -> None:  # noqa: C901 - one case per action
        do = self._engine.do
        match action:
            case CreateNetwork(name):
                labels = {MANAGED: "true"}
                do("create_network", name, driver="bridge", labels=labels, check_duplicate=True)
            case CreateSandbox(spec):
                self._create(spec.name, sandbox_config(spec, self._settings))
            case Create(spec):
                token = look.tokens.get(spec.key) or secrets.token_hex(16)
                address = look.master_address(spec.key)
                self._create(spec.name, container_config(spec, self._settings, token, address))
            case Start(name):
                do("start", name)
            case Restart(name):
                do("restart", name, timeout=STOP_TIMEOUT)
            case Unpause(name):
                do("unpause", name)
            case Rename(name, to):
                do("rename", name, to)
            case Connect(name, network, aliases):
                do("connect_container_to_network", name, network, aliases=list(aliases))
            case Disconnect(name, network):  # also from one that does not exist any more
                do("disconnect_container_from_network", name, network, force=True)
            case Remove():
                self._remove(action, look)

    def _remove(self, action: Remove, look: DockerSnapshot) -> None:
        name = action.name
        if action.stop:
            try:
                self._engine.do("stop", name, timeout=STOP_TIMEOUT)
            except EngineError as error:
                log.debug("%s is killed, as it can't be stopped: %s", name, error)
        # The engine lays the published ports anew over each network that a container still has
        # when it ends, which takes 2 s per network.
        networks = self._engine.container(name)["NetworkSettings"].get("Networks") or {}
        for network in networks:
            if network != self._settings.uplink:
                self._do(Disconnect(name, network), look)
        self._engine.do("remove_container", name, force=True)

    def _create(self, name: str, config: Json) -> None:
        try:
            self._engine.do("create_container_from_config", config, name)
        except Conflict:
            labels = self._engine.container(name)["Config"].get("Labels") or {}
            if read_own(labels) is None:
                raise EngineError(
                    f"a container that is not this operator's is called {name}; "
                    f"rename it (docker rename {name} …) or remove it"
                ) from None
