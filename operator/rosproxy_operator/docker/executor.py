"""Carrying out what was planned, each key's work apart from the others'.

A key's work may take a minute (the engine publishes a thousand ports) or fail for ever; meanwhile
looks go on and the other keys are served.

Every action may be carried out twice, or after somebody else did it, or on something that has
vanished meanwhile: that is no error, the next look sees what is left to do.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass

from rosproxy.net.tasks import Tasks
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.proxy_client import ProxyClient, ProxyError
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.docker import engine_json
from rosproxy_operator.docker.engine_client import DockerClient, Json
from rosproxy_operator.docker.errors import Conflict, EngineError, NoSuchObject, PortTaken
from rosproxy_operator.docker.planner.actions import (
    Action,
    Connect,
    Create,
    CreateFlush,
    CreateLanRelay,
    CreateNetwork,
    CreateRedirect,
    CreateSandbox,
    Disconnect,
    Remove,
    RemoveNetwork,
    Rename,
    Restart,
    Run,
    Start,
    Unpause,
)
from rosproxy_operator.docker.planner.flush import flush_config
from rosproxy_operator.docker.planner.model import Key
from rosproxy_operator.docker.planner.own_containers import forgery_reason
from rosproxy_operator.docker.planner.plan import Group
from rosproxy_operator.docker.planner.redirect import redirect_config
from rosproxy_operator.docker.planner.specs import (
    MANAGED,
    SECRET,
    Creation,
    container_config,
    lan_relay_config,
    master,
    proxy_name,
    read_own,
    sandbox_config,
)
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess

log = logging.getLogger(__name__)

BACK_OFF = (1.0, 2.0, 5.0, 15.0, 60.0)
"""Seconds until the same actions are tried again that have failed; the last is repeated."""
QUIET = 120.0
"""Seconds without a failure after which the same one is worth a line in the log again."""
STOP_TIMEOUT = 2
"""Seconds that a process has to end before it is killed."""
DONE: dict[type, tuple[str, ...]] = {
    # moby has them in libnetwork and in daemon/{unpause,rename,delete,container_operations}.go.
    CreateNetwork: ("already exists",),
    Start: ("is not running",),
    Restart: (),
    Run: ("non running container",),
    Unpause: ("is not paused",),
    Rename: ("same name as its current name",),
    Connect: ("already exists in network", "already attached"),
    Disconnect: ("is not connected",),
    Remove: ("is already in progress",),
    RemoveNetwork: (),
}
"""Parts of the engine's error that mean there is nothing left to do; so does NoSuchObject."""

LONGEST_RUN = 30.0
"""Seconds after which a container that does one thing is given up.

Setting a redirect takes milliseconds. Deleting entries takes 13 s where each of 1,000 ports has
some.
"""
RUNNING = 0.03
"""Seconds between two checks whether it has ended."""

CarryOut = Callable[[Action], Awaitable[None]]
Job = tuple[Key | None, str]
"""What is worked on independently: a group's key, and what it is about."""
UPLINK: Job = (None, "")


@dataclass(slots=True)
class _Failure:
    """What failed for a key, how often in a row, when to try again, and the problem to report."""

    actions: list[Action]
    count: int
    retry_at: float
    problem: Problem


class Executor:
    """Carries groups of actions out, those of one key one after the other.

    ``finished`` is called when a key's work is over, ``port_taken`` with a container's name and the
    port (None if unknown) when it could not be started for that, ``counted`` with each action and
    its outcome (ok, failed, taken). ``now`` is the clock, in monotonic seconds.
    """

    def __init__(
        self,
        tasks: Tasks,
        finished: Callable[[], None],
        port_taken: Callable[[str, int | None], None],
        counted: Callable[[Action, str], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tasks = tasks
        self._finished = finished
        self._now = now
        self._port_taken = port_taken
        self._counted = counted
        self._busy: dict[Job, asyncio.Task[None]] = {}
        self._failures: dict[Job, _Failure] = {}
        self._ended_at: dict[Job, float] = {}
        self._refused: dict[Action, tuple[str, float]] = {}

    @property
    def busy(self) -> frozenset[str]:
        """What is being worked on, as problems name it."""
        return frozenset(map(_subject, self._busy))

    @property
    def problems(self) -> list[Problem]:
        """What has failed and was not put right yet."""
        return [failure.problem for failure in self._failures.values()]

    @property
    def again_in(self) -> float | None:
        """Seconds until something that has failed may be tried again; None if nothing has."""
        times = [f.retry_at for job, f in self._failures.items() if job not in self._busy]
        return max(min(times) - self._now(), 0.0) if times else None

    def start(self, groups: Iterable[Group], carry_out: CarryOut, looked_at: float) -> None:
        """Begin what is not under way and did not fail just now, and return.

        ``looked_at`` is when the look began (monotonic) from which the groups were planned: a job
        that ended later may have done something that it did not see.
        """
        now = self._now()
        self._refused = {a: r for a, r in self._refused.items() if r[1] > now - QUIET}
        by_job: dict[Job, list[Group]] = {}
        for group in groups:
            job = group.key, group.subject
            if self._ended_at.get(job, 0.0) < looked_at:
                by_job.setdefault(job, []).append(group)
        self._ended_at = {job: at for job, at in self._ended_at.items() if at >= looked_at}
        self._failures = {
            job: f for job, f in self._failures.items() if job in by_job or job in self._ended_at
        }
        for job in sorted(by_job, key=lambda job: job[0] is not None):  # the uplink first
            actions = [action for group in by_job[job] for action in group.actions]
            failure = self._failures.get(job)
            # Other actions than those that failed are tried at once: something has changed.
            waiting = failure and failure.actions == actions and now < failure.retry_at
            if actions and not waiting and job not in self._busy:
                work = self._run(job, by_job[job], actions, carry_out)
                self._busy[job] = self._tasks.spawn(work, f"work for {_subject(job)}")

    async def _run(
        self, job: Job, groups: list[Group], actions: list[Action], carry_out: CarryOut
    ) -> None:
        """Carry out all groups, after the uplink's, and note the first thing that goes wrong."""
        problem: Problem | None = None
        try:
            if job != UPLINK and UPLINK in self._busy:
                await asyncio.wait([self._busy[UPLINK]])
            problems = [await self._carry_out_group(group, carry_out) for group in groups]
            problem = next(filter(None, problems), None)
        except Exception as error:  # a mistake of ours: no reason to try it in a tight loop
            log.exception("work for %s failed", _subject(job))
            problem = Problem(_subject(job), f"the operator failed: {error!r}")
        finally:
            previous = self._failures.pop(job, None)
            if problem is not None:
                count = previous.count + 1 if previous and previous.actions == actions else 1
                retry_at = self._now() + BACK_OFF[min(count, len(BACK_OFF)) - 1]
                self._failures[job] = _Failure(actions, count, retry_at, problem)
            del self._busy[job]
            self._ended_at[job] = self._now()
            self._finished()

    async def _carry_out_group(self, group: Group, carry_out: CarryOut) -> Problem | None:
        """Carry a group out as far as possible; returns what went wrong.

        A network that can't be joined or left does not keep a proxy from serving the others.
        """
        problem: Problem | None = None
        for action in group.actions:
            try:
                await self._carry_out_action(action, carry_out)
            except PortTaken as error:
                self._port_taken(action.name, error.port)
                break
            except EngineError as error:
                fix = f". {group.fix}" if group.fix else ""
                subject = _subject((group.key, group.subject))
                problem = Problem(subject, f"{action}: {error}{fix}", group.fatal)
                if not isinstance(action, Connect | Disconnect):
                    break
        return problem

    async def _carry_out_action(self, action: Action, carry_out: CarryOut) -> None:
        """Carry an action out, and log why it failed: once while it is tried again and again."""
        previous, _ = self._refused.get(action, (None, 0.0))
        fields = action.log_fields
        log.log(logging.INFO if previous is None else logging.DEBUG, "%s", action, extra=fields)
        outcome = "failed"
        started = self._now()
        try:
            await carry_out(action)
            outcome = "ok"
            self._refused.pop(action, None)
        except EngineError as error:
            reason = str(error)
            if isinstance(error, PortTaken):
                outcome = reason = "taken"  # maybe another port each time
            level = logging.DEBUG if reason == previous else logging.WARNING
            log.log(level, "%s: %s", action, error, extra=fields)
            self._refused[action] = reason, self._now()
            raise
        finally:
            self._counted(action, outcome)
            log.debug("%s: %s in %.3f s", action, outcome, self._now() - started)


def _subject(job: Job) -> str:
    key, subject = job
    return subject or (f"proxy {proxy_name(key)}" if key else "uplink")


class DockerApplier:
    """Carries out actions, each in a thread."""

    def __init__(self, engine: DockerClient, settings: PlanSettings, proxies: ProxyClient) -> None:
        self._engine = engine
        self._settings = settings
        self._proxies = proxies

    async def carry_out(self, action: Action, snapshot: DockerSnapshot) -> None:
        """Carry out an action that was planned from a look. Raises EngineError."""
        if isinstance(action, Remove) and action.retire and action.name in snapshot.access:
            await self._retire(action.name, snapshot.access[action.name])
        await in_thread(self._do, action, snapshot)

    async def _retire(self, name: str, access: ProxyAccess) -> None:
        fields = {"proxy": name}
        try:
            answer = await self._proxies.retire(access.admin, access.token)
            text = "proxy retired: %s, outside was told that %s nodes or participants have ended"
            log.info(text, name, answer.get("unregistered"), extra=fields)
        except ProxyError as error:
            text = "proxy not retired: %s, outside was not told that its nodes have ended: %s"
            log.warning(text, name, error, extra=fields)

    def _do(self, action: Action, snapshot: DockerSnapshot) -> None:
        try:
            self._call(action, snapshot)
        except EngineError as error:
            phrases = DONE.get(type(action))
            if phrases is None or not (
                isinstance(error, NoSuchObject) or any(phrase in str(error) for phrase in phrases)
            ):
                raise
            log.debug("nothing left to do: %s", error)

    def _call(self, action: Action, snapshot: DockerSnapshot) -> None:  # noqa: C901 - cases only
        do = self._engine.do
        match action:
            case CreateNetwork() | RemoveNetwork() | Connect() | Disconnect():
                self._call_network(action, snapshot)
            case CreateSandbox() | Create() | CreateLanRelay() | CreateRedirect() | CreateFlush():
                self._create(action.name, self._config(action, snapshot), snapshot.state.image_id)
            case Start(name):
                do("start", name)
            case Run(name):
                do("start", name)
                self._await_end(name)
            case Restart(name):
                do("restart", name, timeout=STOP_TIMEOUT)
            case Unpause(name):
                do("unpause", name)
            case Rename(name, to):
                do("rename", name, to)
            case Remove():
                self._remove(action, snapshot)

    def _call_network(
        self, action: CreateNetwork | RemoveNetwork | Connect | Disconnect, snapshot: DockerSnapshot
    ) -> None:
        do = self._engine.do
        match action:
            case CreateNetwork(name):
                labels = {MANAGED: "true", SECRET: snapshot.new_secret}
                # Without check_duplicate engines before API 1.44 may make a second one of the name.
                do("create_network", name, driver="bridge", labels=labels, check_duplicate=True)
            case RemoveNetwork(name):
                do("remove_network", name)
            case Connect(name, network, aliases):
                do("connect_container_to_network", name, network, aliases=list(aliases))
            case Disconnect(name, network):  # also from one that does not exist any more
                do("disconnect_container_from_network", name, network, force=True)

    def _await_end(self, name: str) -> None:
        """Wait until a container has ended. Raises EngineError if it failed or takes too long."""
        since = time.monotonic()
        while (state := self._engine.container(name)["State"])["Running"]:
            if time.monotonic() > since + LONGEST_RUN:
                self._engine.do("remove_container", name, force=True)
                raise EngineError(
                    f"not ended after {LONGEST_RUN:.0f} s, and removed by the operator"
                )
            time.sleep(RUNNING)
        if state["ExitCode"]:
            raise EngineError(f"ended with exit code {state['ExitCode']}. Read docker logs {name}")

    def _config(self, action: Creation, snapshot: DockerSnapshot) -> Json:
        if isinstance(action, CreateSandbox):
            return sandbox_config(action, self._settings)
        if isinstance(action, CreateLanRelay):
            return lan_relay_config(action, self._settings, snapshot.state.secret)
        if isinstance(action, CreateRedirect):
            return redirect_config(action, self._settings)
        if isinstance(action, CreateFlush):
            return flush_config(action, self._settings)
        secret = snapshot.state.secret
        masters = snapshot.state.masters
        key = action.key
        address = masters.get(master(key).host.lower(), "") if key.ros == "1" else ""
        return container_config(action, self._settings, secret, address)

    def _remove(self, action: Remove, snapshot: DockerSnapshot) -> None:
        name = action.name
        if action.stop:
            try:
                self._engine.do("stop", name, timeout=STOP_TIMEOUT)
            except EngineError as error:
                log.debug("container not stopped, so it is killed: %s: %s", name, error)
        # The engine lays the published ports anew over each network that a container still has
        # when it ends, which takes 2 s per network.
        networks = self._engine.container(name)["NetworkSettings"].get("Networks") or {}
        for network in networks:
            if network not in (self._settings.uplink, "host"):  # no container leaves the latter
                self._do(Disconnect(name, network), snapshot)
        self._engine.do("remove_container", name, force=True)

    def _create(self, name: str, config: Json, image_id: str) -> None:
        try:
            self._engine.do("create_container_from_config", config, name)
        except Conflict:
            # Our own of that name is all right: an earlier call may have made it and its answer
            # been lost. The next look compares it with what is wanted.
            container = self._engine.container(name)
            own = read_own(container["Config"].get("Labels") or {})
            making = engine_json.read_making(container)
            if own is None or forgery_reason(own, name, making, image_id):
                raise EngineError(
                    f"a container {name} exists already that this operator did not create. Rename "
                    f"that container (docker rename {name} …) or remove it"
                ) from None
