"""The process of a proxy for ROS 1, ROS 2, rmw_zenoh, or several, with a single admin endpoint."""

import asyncio
import contextlib
import logging
import resource
import socket
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping
from typing import Any

from msgspec.structs import replace

from rosproxy.admin.admin_server import Action, AdminServer
from rosproxy.admin.common_status import common_status
from rosproxy.app.policy_sources import PolicySources
from rosproxy.app.self_check import SelfCheck
from rosproxy.app.signals import stop_event
from rosproxy.app.stacks import make_stacks
from rosproxy.binding import setting_error_if_taken
from rosproxy.net import proxy_signs
from rosproxy.page.feed import Feed, PageWatch
from rosproxy.page.problem_ages import ProblemAges
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.runtime import Runtime
from rosproxy.shared.connections import sockets
from rosproxy.shared.documents.status_bounds import bounded
from rosproxy.shared.documents.status_document import ProxyStatus, to_json
from rosproxy.shared.http.admin_client import default_url
from rosproxy.shared.settings import Settings

log = logging.getLogger(__name__)

new_event_loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop
# uvloop is an extra (pyproject.toml). The image has it only if it is built with this extra.
with contextlib.suppress(ImportError):
    from uvloop import new_event_loop


class App:
    """A proxy. Call `start` and `stop` in the same running event loop."""

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
        ages = ProblemAges()

        def look() -> AsyncGenerator[dict[str, Any]]:
            return PageWatch(self.state, lambda: self._check.findings, admin, ages).documents()

        visitors = Visitors(settings.token_hash, runtime.now, own_names=_own_names(settings))
        return Page(Feed(runtime.tasks, look), visitors)

    async def start(self) -> None:
        """Bind all ports, and start all stacks. Raises SettingError if a port is taken."""
        settings = self.settings
        # First bind any free port: if this host does not have the address, the error names --bind.
        # Otherwise all ports of the range would seem taken.
        with setting_error_if_taken("--bind", settings.bind):
            sockets.bind(settings.bind, 0).close()
        # The policy comes first: a stack lets nodes register, and recovers the nodes of an earlier
        # process.
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
        """Stop the live page, the admin endpoint and all stacks."""
        if self._sign:
            self._sign.close()
        # The streams of the page end first: aiohttp waits up to a minute for open handlers
        # (web_runner.py, shutdown_timeout).
        await self.page.close()
        await self._admin.stop()
        for stack in self.stacks:
            await stack.stop()

    def status(self) -> dict[str, Any]:
        """The state of the proxy, ready for JSON."""
        return to_json(self.state())

    def state(self) -> ProxyStatus:
        """The state of the proxy, within the bound of `status_bounds`."""
        self.runtime.refusals.end_old()
        status = replace(common_status(self.runtime), range_probe=self._check.result)
        for stack in self.stacks:
            status = stack.extended_status(status)
        return bounded(status)

    def _actions(self) -> dict[str, Action]:
        """The POST actions of all stacks, by path; several stacks may have an action for a path.

        The action of ROS 1 comes last, because it may fail while the master is away.
        """
        action_maps = [stack.actions for stack in reversed(self.stacks)]
        paths = {path for actions in action_maps for path in actions}
        return {path: _together([a[path] for a in action_maps if path in a]) for path in paths}

    def _unready(self) -> str | None:
        return next(filter(None, (stack.unready() for stack in self.stacks)), None)


def _own_names(settings: Settings) -> frozenset[str]:
    """The advertised host and the host name of the proxy, in lower case."""
    names = {settings.advertise_host.lower(), socket.gethostname().lower()}
    return frozenset(names - {""})


def _together(actions: list[Action]) -> Action:
    """An action that carries out several actions in order, and adds up their replies (counts)."""
    if len(actions) == 1:
        return actions[0]

    async def act(body: Any) -> dict[str, Any]:
        counts = Counter[str]()
        for action in actions:
            counts.update(await action(body))
        return dict(counts)

    return act


def run(settings: Settings, remarks: Mapping[str, str]) -> None:
    """Run a proxy until SIGINT or SIGTERM. Raises SettingError if a port is taken.

    ``remarks``: problems for the status of the proxy, texts by subject.
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
    """Raise the limit of open files to the hard limit of this process (``ulimit -Hn``).

    A relayed connection takes up to six file descriptors: two sockets, and two pipes with two each.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    # If the system refuses, the proxy runs with fewer connections.
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
