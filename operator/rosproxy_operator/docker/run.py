"""Running the commands for Docker."""

import asyncio
import json
import logging
import signal
import time

from rosproxy import __version__
from rosproxy.cli.terminal import size, watch, write
from rosproxy_operator.common.health import HealthServer
from rosproxy_operator.common.metrics import DockerMetrics
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.docker.controller import DockerController
from rosproxy_operator.docker.errors import EngineError
from rosproxy_operator.docker.planner.model import PlanSettings
from rosproxy_operator.docker.planner.report import plan_text, render
from rosproxy_operator.docker.settings import DockerSettings
from rosproxy_operator.docker.status import describe, survey

log = logging.getLogger(__name__)

ONCE = 60.0
"""Seconds within which ``--once`` has to reach what is wanted."""


def run(settings: DockerSettings) -> None:
    """Run the operator until a signal ends it; its proxies go on. Raises SettingError."""
    asyncio.run(_run(settings))


def run_once(settings: DockerSettings) -> list[Problem]:
    """Look and act until nothing is left to do; what is not as wanted. Raises LookFailed."""
    return asyncio.run(_run_once(settings))


def show_plan(settings: PlanSettings) -> None:
    """Print what would be done now, and what is wrong. Raises EngineError."""
    found = asyncio.run(survey(settings))
    write(plan_text(found.actions))
    for problem in found.problems:
        write(f"{problem.subject}: {problem.text}")


def show_status(settings: PlanSettings, as_json: bool) -> None:
    """Print what there is on the host. Raises EngineError."""
    found = asyncio.run(survey(settings))
    status = describe(found, settings)
    write(json.dumps(status, indent=2) if as_json else render(status, size()[0]))


def watch_status(settings: PlanSettings) -> None:
    """Draw the status again and again until interrupted, also while no engine answers."""

    def draw(columns: int, lines: int | None) -> str:
        try:
            return render(describe(asyncio.run(survey(settings)), settings), columns, lines)
        except EngineError as error:
            return f"{time.strftime('%H:%M:%S')} {error}"

    watch(draw)


async def _run(settings: DockerSettings) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    metrics = DockerMetrics()
    controller = DockerController(settings, metrics)
    health = HealthServer(metrics.registry, controller.dead, controller.unready)
    await health.start(settings.admin)
    log.info("rosproxy-operator %s: health and metrics at http://%s", __version__, settings.admin)
    running = asyncio.create_task(controller.run())
    stopping = asyncio.create_task(stopped.wait())
    await asyncio.wait([running, stopping], return_when=asyncio.FIRST_COMPLETED)
    if running.done():
        running.result()  # raises what it died of
    running.cancel()
    await asyncio.gather(running, stopping, health.stop(), return_exceptions=True)


async def _run_once(settings: DockerSettings) -> list[Problem]:
    return await DockerController(settings, DockerMetrics()).run_once(ONCE)
