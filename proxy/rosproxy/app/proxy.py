"""One proxy: for ROS 1, for ROS 2, or for both, with one admin endpoint."""

import asyncio
import contextlib
import logging
import os
import resource
import socket
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Mapping
from typing import Any

import msgspec

from rosproxy import __version__
from rosproxy.admin.client import default_url
from rosproxy.admin.server import Action, AdminServer
from rosproxy.admin.status import problem_statuses
from rosproxy.admin.status_document import (
    DomainStatus,
    PortsStatus,
    ProxyStatus,
    StatusSettings,
    to_json,
)
from rosproxy.app.binding import setting_error_if_taken
from rosproxy.app.policy_sources import PolicySources
from rosproxy.app.ros1 import Ros1
from rosproxy.app.ros2 import Ros2
from rosproxy.app.self_check import SelfCheck
from rosproxy.app.signals import stop_event
from rosproxy.net import signs, sockets
from rosproxy.page.feed import Feed, PageWatch
from rosproxy.page.routes import Page
from rosproxy.page.visitors import Visitors
from rosproxy.ros1.protocol.master_methods import KNOWN_METHODS
from rosproxy.runtime import Runtime
from rosproxy.settings import Settings

log = logging.getLogger(__name__)

new_event_loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.new_event_loop
with contextlib.suppress(ImportError):
    from uvloop import new_event_loop


class App:
    """One proxy. `start` it in a running event loop, `stop` it in the same."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.runtime = runtime = Runtime(settings, KNOWN_METHODS)
        self.ros1 = Ros1(runtime) if settings.for_ros1 else None
        self.ros2 = Ros2(runtime) if settings.for_ros2 else None
        self._policy = PolicySources(runtime, self.ros1, self.ros2)
        self._check = SelfCheck(runtime, self.ros1, self.ros2)
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
        )

    def _make_page(self) -> Page:
        runtime, settings = self.runtime, self.settings
        admin = default_url(str(settings.admin))

        def look() -> AsyncGenerator[dict[str, Any]]:
            return PageWatch(self.state, lambda: self._check.findings, admin).documents()

        return Page(Feed(runtime.tasks, look), Visitors(settings.token_hash, runtime.now))

    async def start(self) -> None:
        """Bind all ports and begin. Raises SettingError if a port is taken."""
        settings = self.settings
        with setting_error_if_taken("--bind", settings.bind):
            sockets.bind(settings.bind, 0).close()
        self._policy.start()
        stacks = [stack for stack in (self.ros1, self.ros2) if stack]
        for stack in stacks:
            await stack.start()
        with setting_error_if_taken("--admin-bind", settings.admin):
            await self._admin.start(settings.admin)
        ports = settings.ports.listen
        self._sign = signs.publish_sign(settings.ros, ports.first, ports.last, settings.admin)
        await self._check.start()
        log.info("ready: %s", "; ".join(stack.greeting for stack in stacks))

    async def stop(self) -> None:
        """End everything."""
        if self._sign:
            self._sign.close()
        await self.page.close()
        await self._admin.stop()
        if self.ros1:
            await self.ros1.stop()
        await self.runtime.tasks.cancel()
        if self.ros2:
            await self.ros2.stop()

    def status(self) -> dict[str, Any]:
        """The state as JSON."""
        return to_json(self.state())

    def state(self) -> ProxyStatus:
        """The state."""
        domains = self.ros2.state.status() if self.ros2 else ()
        status = self.ros1.status() if self.ros1 else self._bare_status(domains)
        if self.ros2:
            policy = self.ros2.state.policy(self.runtime.policy, status.policy)
            status = msgspec.structs.replace(status, domains=domains, policy=policy)
        return status

    def _actions(self) -> dict[str, Action]:
        """What posts at the admin endpoint do: in ROS 1 and ROS 2 where both know them."""
        action_maps = [stack.actions for stack in (self.ros2, self.ros1) if stack]
        paths = {path for actions in action_maps for path in actions}
        return {path: _together([a[path] for a in action_maps if path in a]) for path in paths}

    def _unready(self) -> str | None:
        return self.ros1.unready() if self.ros1 else None

    def _bare_status(self, domains: tuple[DomainStatus, ...]) -> ProxyStatus:
        """The state of a proxy without ROS 1."""
        runtime, settings = self.runtime, self.settings
        return ProxyStatus(
            version=__version__,
            pid=os.getpid(),
            instance=runtime.instance,
            uptime=round(runtime.uptime(), 1),
            settings=StatusSettings(
                ros=settings.ros,
                advertise_host=settings.advertise_host,
                bind=settings.bind,
                inside_networks=tuple(map(str, self.ros2.networks)) if self.ros2 else (),
                direction=settings.direction,
            ),
            ports=PortsStatus(
                str(settings.ports.listen),
                str(settings.ports.advertise),
                sum(domain.ports_used for domain in domains),
                sum(domain.ports_free for domain in domains),
            ),
            data_plane=domains[0].data_plane if domains else None,
            problems=problem_statuses(runtime.problems),
        )


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
        app.runtime.problems.add(subject, text)
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
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
