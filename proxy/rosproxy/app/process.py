"""One proxy: for ROS 1, ROS 2, rmw_zenoh, or several of these, with one admin endpoint."""

import asyncio
import contextlib
import logging
import resource
import socket
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping
from typing import Any

from msgspec.structs import replace

from rosproxy.admin.admin_client import default_url
from rosproxy.admin.admin_server import Action, AdminServer
from rosproxy.admin.common_status import common_status
from rosproxy.admin.status_bounds import bounded
from rosproxy.admin.status_document import ProxyStatus, to_json
from rosproxy.app.policy_sources import PolicySources
from rosproxy.app.self_check import SelfCheck
from rosproxy.app.signals import stop_event
from rosproxy.app.stacks import make_stacks
from rosproxy.binding import setting_error_if_taken
from rosproxy.net import proxy_signs, sockets
from rosproxy.page.feed import Feed, PageWatch
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.runtime import Runtime
from rosproxy.settings import Settings

log = logging.getLogger(__name__)

new_event_loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop
# uvloop is an extra (pyproject.toml). The image has it only if it is built with this extra.
with contextlib.suppress(ImportError):
    from uvloop import new_event_loop


class App:
    """One proxy. `start` it in a running event loop, `stop` it in the same."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.runtime = runtime = Runtime(settings)
        self.stacks = make_stacks(runtime)
        self._policy = PolicySources(runtime, self.stacks)
        self._check = SelfCheck(runtime, self.stacks)
        self._sign: socket.socket | None = None
        self.page = self._make_page()
        self._admin = AdminServer(
            runtime.metrics.registry,
            self.state,
            self._unready,
            {
                "/policy": self._policy.post,
                "/probe": self._check.probe,
                "/page-key": self.page.visitors.issue_key,
                **self._actions(),
            },
            settings.token_hash,
            self.page.routes,
            _own_names(settings),
        )

    def _make_page(self) -> Page:
        runtime = self.runtime
        settings = self.settings
        admin = default_url(str(settings.admin))

        def look() -> AsyncGenerator[dict[str, Any]]:
            return PageWatch(self.state, lambda: self._check.findings, admin).documents()

        visitors = Visitors(settings.token_hash, runtime.now, own_names=_own_names(settings))
        return Page(Feed(runtime.tasks, look), visitors)

    async def start(self) -> None:
        """Bind all ports and begin. Raises SettingError if a port is taken."""
        settings = self.settings
        # Any free port: an address that this host does not have is the fault of --bind, and would
        # otherwise look as if all ports of the range were taken.
        with setting_error_if_taken("--bind", settings.bind):
            sockets.bind(settings.bind, 0).close()
        # Before any node can register, or a former process's nodes are found again.
        self._policy.start()
        for stack in self.stacks:
            await stack.start()
        with setting_error_if_taken("--admin-bind", settings.admin):
            await self._admin.start(settings.admin)
        if versions := settings.range_versions:
            ports = settings.ports.listen
            self._sign = proxy_signs.publish_sign(versions, ports.first, ports.last, settings.admin)
        await self._check.start()
        log.info("listening: %s", "; ".join(stack.greeting for stack in self.stacks))

    async def stop(self) -> None:
        """End everything."""
        if self._sign:
            self._sign.close()
        # The page's streams end first: aiohttp waits up to a minute for handlers under way
        # (web_runner.py, shutdown_timeout).
        await self.page.close()
        await self._admin.stop()
        for stack in self.stacks:
            await stack.stop()

    def status(self) -> dict[str, Any]:
        """The state as JSON."""
        return to_json(self.state())

    def state(self) -> ProxyStatus:
        """The state, within the bound of the status."""
        self.runtime.refusals.end_old()
        status = replace(common_status(self.runtime), range_probe=self._check.result)
        for stack in self.stacks:
            status = stack.add_to(status)
        return bounded(status)

    def _actions(self) -> dict[str, Action]:
        """What posts at the admin endpoint do: in ROS 1 and ROS 2 where both know them.

        ROS 2 goes first: ROS 1 may fail, where its master is away.
        """
        action_maps = [stack.actions for stack in reversed(self.stacks)]
        paths = {path for actions in action_maps for path in actions}
        return {path: _together([a[path] for a in action_maps if path in a]) for path in paths}

    def _unready(self) -> str | None:
        return next(filter(None, (stack.unready() for stack in self.stacks)), None)


def _own_names(settings: Settings) -> frozenset[str]:
    """The names that the proxy is known by, in lower case."""
    names = {settings.advertise_host.lower(), socket.gethostname().lower()}
    return frozenset(names - {""})


def _together(actions: list[Action]) -> Action:
    """Does several actions one after the other; their counts are added up."""
    if len(actions) == 1:
        return actions[0]

    async def act(body: Any) -> dict[str, Any]:
        counts = Counter[str]()
        for action in actions:
            counts.update(await action(body))
        return dict(counts)

    return act


def run(settings: Settings, remarks: Mapping[str, str]) -> None:
    """Run a proxy until a signal ends it; ``remarks`` are problems that its status is to tell.

    Raises SettingError if a port is taken.
    """
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(_run_until_signal(settings, remarks))


async def _run_until_signal(settings: Settings, remarks: Mapping[str, str]) -> None:
    ending = stop_event()
    _raise_file_limit()
    app = App(settings)
    for subject, text in remarks.items():
        app.runtime.problems.add(subject, text, holds=True)
    try:
        await app.start()
        await ending.wait()
    finally:
        await app.stop()


def _raise_file_limit() -> None:
    """Have as many open files as the system lets this process have at most (``ulimit -Hn``).

    Each relayed connection takes up to six: two sockets and two pipes.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    # Where that is refused the proxy runs as well, with fewer connections.
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
