"""Carry out plans, in a job for each proxy, each redirect, each flush and the uplink.

A flush is the helper container that deletes conntrack entries of a proxy (`planner.flush`).
A job may take a minute (the engine publishes a thousand ports) or fail at every try. Meanwhile the
operator looks again, and other jobs run.

If an action is already done, or its container or network has gone since the look, nothing is left
to do: no error. An exception is the creation of a container, which fails without its image or
network.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass

from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.problem import (
    FAILED,
    NOT_ADMITTED,
    Problem,
)
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
from rosproxy_operator.docker.planner.own_containers import forgery_reason
from rosproxy_operator.docker.planner.plan import Group
from rosproxy_operator.docker.planner.redirect import redirect_config
from rosproxy_operator.docker.planner.specs import (
    MANAGED,
    SECRET,
    Creation,
    container_config,
    lan_relay_config,
    proxy_name,
    read_own,
    sandbox_config,
)
from rosproxy_operator.docker.settings import PlanSettings
from rosproxy_operator.docker.snapshot import DockerSnapshot, ProxyAccess
from rosproxy_operator.proxy_spec.place import Master, Place

log = logging.getLogger(__name__)

RETRY_PAUSES_S = (1.0, 2.0, 5.0, 15.0, 60.0)
"""Pauses in seconds after one, two, … failures of a job in succession. The last pause repeats."""
FAILURE_REMEMBERED_S = 120.0
"""Seconds after which a failure of an action is forgotten, if the action has not failed again.

If the same failure comes again within this time, the operator does not log another warning. A retry
starts at most 60 s after the end of the last run. So a lasting failure is logged as a warning once,
unless a run takes longer than the other 60 s. Meanwhile the status reports the problem.
"""
STOP_TIMEOUT_S = 2
"""Seconds that the engine gives a container to end, before it kills the container."""
HARMLESS_ERRORS: dict[type, tuple[str, ...]] = {
    # moby has these texts in libnetwork and in
    # daemon/{unpause,rename,delete,container_operations}.go.
    CreateNetwork: ("already exists",),
    Start: ("is not running",),  # the sandbox has ended: the next look plans its start
    Restart: (),
    Run: ("non running container",),
    Unpause: ("is not paused",),
    Rename: ("same name as its current name",),
    Connect: ("already exists in network", "already attached"),
    Disconnect: ("is not connected",),
    Remove: ("is already in progress",),
    RemoveNetwork: (),
}
"""For each type of action: texts in the engine's errors that mean that nothing is left to do.

For these types, the error NoSuchObject also means that nothing is left to do. For all other types
every error is a failure, except a Conflict with the operator's own container (`_create`).
"""

LONGEST_HELPER_RUN_S = 30.0
"""Seconds after which the operator removes a helper container that has not ended.

Setting a redirect takes milliseconds. Deleting conntrack entries takes 13 s if each of 1,000 ports
has entries.
"""
END_POLL_INTERVAL_S = 0.03
"""Seconds between two checks whether a helper container has ended."""

CarryOut = Callable[[Action], Awaitable[None]]
Job = tuple[Place | None, str]
"""A job: the place and the subject of the groups. Different jobs run at the same time."""
UPLINK: Job = (None, "")
"""The job of the uplink network, which has neither place nor subject."""


@dataclass(slots=True)
class _Failure:
    """The actions of the last run of a job, which has failed, and the problem to report.

    ``count`` is the number of failures in succession. ``retry_at`` is in monotonic seconds.
    """

    actions: list[Action]
    count: int
    retry_at: float
    problem: Problem


class Executor:
    """Carries out groups of actions. The groups of a job run one after the other.

    ``finished`` is called when a job has ended. If a taken port keeps a container from starting,
    ``port_taken`` is called with the container's name and the port. The port is None if the error
    names no port. ``counted`` is called with each action and its outcome: ok, failed or taken.
    ``now`` is a monotonic clock.
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
        self._logged_failures: dict[Action, tuple[str, float]] = {}

    @property
    def busy(self) -> frozenset[str]:
        """The subjects of the running jobs, as in `Problem.subject`."""
        return frozenset(map(_problem_subject, self._busy))

    @property
    def problems(self) -> list[Problem]:
        """The problem of each planned job whose last run failed."""
        return [failure.problem for failure in self._failures.values()]

    @property
    def again_in(self) -> float | None:
        """Seconds until the first failed job may be tried again; None without such a job."""
        times = [f.retry_at for job, f in self._failures.items() if job not in self._busy]
        return max(min(times) - self._now(), 0.0) if times else None

    def start(self, groups: Iterable[Group], carry_out: CarryOut, looked_at: float) -> None:
        """Start the jobs of a plan, and return. Skip jobs that run or wait after a failure.

        ``looked_at`` is the monotonic time at which the look of this plan began. Jobs that ended
        later are skipped as well: the look may not have seen their results.
        """
        now = self._now()
        oldest = now - FAILURE_REMEMBERED_S
        self._logged_failures = {a: f for a, f in self._logged_failures.items() if f[1] > oldest}
        by_job: dict[Job, list[Group]] = {}
        for group in groups:
            job = group.place, group.subject
            if self._ended_at.get(job, 0.0) < looked_at:
                by_job.setdefault(job, []).append(group)
        self._ended_at = {job: at for job, at in self._ended_at.items() if at >= looked_at}
        self._failures = {
            job: f for job, f in self._failures.items() if job in by_job or job in self._ended_at
        }
        # The uplink first: in _run, the other jobs wait for the running job of the uplink.
        for job in sorted(by_job, key=lambda job: job[0] is not None):
            actions = [action for group in by_job[job] for action in group.actions]
            failure = self._failures.get(job)
            # If the job has other actions than at the failure, it starts at once: the host has
            # changed.
            waiting = failure and failure.actions == actions and now < failure.retry_at
            if actions and not waiting and job not in self._busy:
                work = self._run(job, by_job[job], actions, carry_out)
                self._busy[job] = self._tasks.spawn(work, f"work for {_problem_subject(job)}")

    async def _run(
        self, job: Job, groups: list[Group], actions: list[Action], carry_out: CarryOut
    ) -> None:
        """Wait for the uplink's job, carry out all groups, and record the first problem."""
        problem: Problem | None = None
        try:
            if job != UPLINK and UPLINK in self._busy:
                await asyncio.wait([self._busy[UPLINK]])
            problems = [await self._carry_out_group(group, carry_out) for group in groups]
            problem = next(filter(None, problems), None)
        except Exception as error:  # a fault of the operator: wait as after other failures
            log.exception("work for %s failed", _problem_subject(job))
            problem = Problem(
                _problem_subject(job), f"the operator failed: {error!r}", reason=FAILED
            )
        finally:
            previous = self._failures.pop(job, None)
            if problem is not None:
                count = previous.count + 1 if previous and previous.actions == actions else 1
                retry_at = self._now() + RETRY_PAUSES_S[min(count, len(RETRY_PAUSES_S)) - 1]
                self._failures[job] = _Failure(actions, count, retry_at, problem)
            del self._busy[job]
            self._ended_at[job] = self._now()
            self._finished()

    async def _carry_out_group(self, group: Group, carry_out: CarryOut) -> Problem | None:
        """Carry out a group until an action fails, and return the first problem.

        A group continues after a failed Connect or Disconnect: the proxy can still serve other
        networks. A taken port is no problem here: the next plan decides on the range
        (`planner.allocation`).
        """
        problem: Problem | None = None
        for action in group.actions:
            try:
                await self._carry_out_action(action, carry_out)
            except PortTaken as error:
                self._port_taken(action.name, error.port)
                break
            except EngineError as error:
                # A later failure may be a consequence of the first. The log has both.
                problem = problem or Problem(
                    _problem_subject((group.place, group.subject)),
                    f"{action}: {error}",
                    group.fix,
                    group.fatal,
                    reason=NOT_ADMITTED,
                )
                if not isinstance(action, Connect | Disconnect):
                    break
        return problem

    async def _carry_out_action(self, action: Action, carry_out: CarryOut) -> None:
        """Carry out an action, and log a failure. Raises EngineError.

        After a failure, the next tries, and failures for the same reason, are logged at level DEBUG
        (`FAILURE_REMEMBERED_S`).
        """
        previous, _ = self._logged_failures.get(action, (None, 0.0))
        fields = action.log_fields
        log.log(logging.INFO if previous is None else logging.DEBUG, "%s", action, extra=fields)
        outcome = "failed"
        started = self._now()
        try:
            await carry_out(action)
            outcome = "ok"
            self._logged_failures.pop(action, None)
        except EngineError as error:
            reason = str(error)
            if isinstance(error, PortTaken):
                outcome = reason = "taken"  # the port may differ at each try
            level = logging.DEBUG if reason == previous else logging.WARNING
            log.log(level, "%s: %s", action, error, extra=fields)
            self._logged_failures[action] = reason, self._now()
            raise
        finally:
            self._counted(action, outcome)
            log.debug("%s: %s in %.3f s", action, outcome, self._now() - started)


def _problem_subject(job: Job) -> str:
    """The subject of the problems of a job."""
    place, subject = job
    return subject or (f"proxy {proxy_name(place)}" if place else "uplink")


class DockerActions:
    """Calls the engine to carry out single actions, each action in a thread."""

    def __init__(self, engine: DockerClient, settings: PlanSettings, proxies: ProxyClient) -> None:
        self._engine = engine
        self._settings = settings
        self._proxies = proxies

    async def carry_out(self, action: Action, snapshot: DockerSnapshot) -> None:
        """Carry out an action that was planned from ``snapshot``. Raises EngineError."""
        if isinstance(action, Remove) and action.retire and action.name in snapshot.access:
            await self._retire(action.name, snapshot.access[action.name])
        await in_thread(self._call_tolerantly, action, snapshot)

    async def _retire(self, name: str, access: ProxyAccess) -> None:
        fields = {"proxy": name}
        try:
            answer = await self._proxies.retire(access.admin, access.token)
            text = "proxy retired: %s, outside was told that %s nodes or participants have ended"
            log.info(text, name, answer.get("unregistered"), extra=fields)
        except ProxyError as error:
            text = "proxy not retired: %s, outside was not told that its nodes have ended: %s"
            log.warning(text, name, error, extra=fields)

    def _call_tolerantly(self, action: Action, snapshot: DockerSnapshot) -> None:
        try:
            self._call_engine(action, snapshot)
        except EngineError as error:
            phrases = HARMLESS_ERRORS.get(type(action))
            if phrases is None or not (
                isinstance(error, NoSuchObject) or any(phrase in str(error) for phrase in phrases)
            ):
                raise
            log.debug("nothing left to do: %s", error)

    def _call_engine(self, action: Action, snapshot: DockerSnapshot) -> None:  # noqa: C901 - cases only
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
                do("restart", name, timeout=STOP_TIMEOUT_S)
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
                # Without check_duplicate, engines before API 1.44 may create a second network.
                do("create_network", name, driver="bridge", labels=labels, check_duplicate=True)
            case RemoveNetwork(name):
                do("remove_network", name)
            case Connect(name, network, aliases):
                do("connect_container_to_network", name, network, aliases=list(aliases))
            case Disconnect(name, network):  # with force, also from a network that has vanished
                do("disconnect_container_from_network", name, network, force=True)

    def _await_end(self, name: str) -> None:
        """Wait until a helper container has ended.

        If the container runs longer than `LONGEST_HELPER_RUN_S`, remove it. Raises EngineError
        after the removal, and for an exit code other than 0.
        """
        since = time.monotonic()
        while (state := self._engine.container(name)["State"])["Running"]:
            if time.monotonic() > since + LONGEST_HELPER_RUN_S:
                self._engine.do("remove_container", name, force=True)
                raise EngineError(
                    f"not ended after {LONGEST_HELPER_RUN_S:.0f} s, and removed by the operator"
                )
            time.sleep(END_POLL_INTERVAL_S)
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
        graph = action.place.graph
        address = masters.get(graph.host.lower(), "") if isinstance(graph, Master) else ""
        return container_config(action, self._settings, secret, address)

    def _remove(self, action: Remove, snapshot: DockerSnapshot) -> None:
        name = action.name
        if action.stop:
            try:
                self._engine.do("stop", name, timeout=STOP_TIMEOUT_S)
            except EngineError as error:
                log.debug("container not stopped, so it is killed: %s: %s", name, error)
        # The engine publishes the ports of a sandbox over one network. When a sandbox ends, the
        # engine publishes them anew over each network that the sandbox still has, which takes 2 s
        # per network. So disconnect the networks while the sandbox runs, except the uplink, which
        # has the ports. No sandbox is stopped above: ``action.stop`` is for containers of proxies.
        networks = self._engine.container(name)["NetworkSettings"].get("Networks") or {}
        for network in networks:
            # The engine disconnects no container from the network host.
            if network not in (self._settings.uplink, "host"):
                self._call_tolerantly(Disconnect(name, network), snapshot)
        self._engine.do("remove_container", name, force=True)

    def _create(self, name: str, config: Json, image_id: str) -> None:
        try:
            self._engine.do("create_container_from_config", config, name)
        except Conflict:
            # An earlier call may have created this container although the answer was lost. The next
            # look compares the container with the plan.
            container = self._engine.container(name)
            own = read_own(container["Config"].get("Labels") or {})
            facts = engine_json.read_making(container)
            if own is None or forgery_reason(own, name, facts, image_id):
                raise EngineError(
                    f"a container {name} exists already that this operator did not create. Rename "
                    f"that container (docker rename {name} …) or remove it"
                ) from None
