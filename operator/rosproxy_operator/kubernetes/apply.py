"""Carries out the planned actions on the Kubernetes API.

An action may run twice, after another program did the same, or on an object that no longer exists.
This is no error: the next look plans what is left to do. Before the operator deletes an object, it
reads the facts behind the decision again (`confirm`).
"""

import asyncio
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence

from rosproxy.shared.tasks import Tasks
from rosproxy_operator.common.problem import Problem
from rosproxy_operator.common.proxy_client import ProxyClient, ProxyError
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import (
    POLICIES,
    Api,
    ApiConflict,
    ApiError,
    ApiInvalid,
    ApiNotFound,
    NotLeading,
)
from rosproxy_operator.kubernetes.confirm_deletion import StateChanged, confirm
from rosproxy_operator.kubernetes.planner.actions import (
    Action,
    CreateProxy,
    Creation,
    DeleteProxy,
    Deletion,
    Emit,
    EvictPod,
    ObjectAction,
    PatchStatus,
    SetImage,
    SetPolicy,
)
from rosproxy_operator.kubernetes.planner.manifests import without_cluster_ip
from rosproxy_operator.kubernetes.proxies.proxy_sync import address_of, token_for
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, text_at, texts_at
from rosproxy_operator.kubernetes.resources.cluster import ClusterSnapshot
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.names import CONTAINER, KIND, PLURAL, is_own
from rosproxy_operator.kubernetes.resources.objects import name_of
from rosproxy_operator.kubernetes.status.events import count_patch, event_body
from rosproxy_operator.kubernetes.status.refusal_fixes import NOT_OURS

log = logging.getLogger(__name__)

MOST_PARALLEL_CALLS = 8
"""Most calls to the API server at the same time."""
RETIREMENT_TIMEOUT_S = 10.0
"""Seconds that a proxy has to unregister its nodes before the operator deletes the proxy."""
ADDRESS_RETRY_PAUSES_S = (0.2, 0.5, 1.0)
"""Seconds between tries to create a Service again under the former address.

Pods know only this address. The API server reports a Service as deleted before the address is free.
"""

_HEADLESS = "None"
"""The clusterIP of a Service without an address."""
_PATHS = {"Pod": "pods", "Service": "services", "NetworkPolicy": POLICIES}
"""The plurals in the API's paths, for the kinds that the operator creates and deletes."""
Count = Callable[[Action, str], None]


class ClusterApplier:
    """Carries out actions: RosProxies in parallel, the actions of each RosProxy in order.

    Calls ``counted`` with each action and the outcome (ok, failed). Calls ``doubted`` when an
    object differs from the watched state in two tries in a row: a watch has missed a change.
    ``busy`` is the number of actions that are under way or wait for a turn.
    """

    def __init__(
        self,
        api: Api,
        proxies: ProxyClient,
        tasks: Tasks,
        counted: Count,
        doubted: Callable[[], None] = lambda: None,
    ) -> None:
        self._api = api
        self._proxies = proxies
        self._tasks = tasks
        self._counted = counted
        self._doubted = doubted
        self._stale = set[str]()
        self._room = asyncio.Semaphore(MOST_PARALLEL_CALLS)
        self._retiring: set[str] = set()
        self._retired: set[str] = set()
        self.failures: Mapping[Name, Mapping[Name, str]] = {}
        self.problems: dict[Name, Problem] = {}
        self.busy = 0

    @property
    def failed(self) -> int:
        """The number of failed actions that the operator will try again."""
        return sum(map(len, self.failures.values())) + len(self.problems)

    def forget(self) -> None:
        """Forget all failures and retirements: another operator may have acted meanwhile."""
        self.failures = {}
        self.problems = {}
        self._stale.clear()
        self._retiring.clear()
        self._retired.clear()

    async def carry_out(self, actions: Iterable[Action], observed: ClusterSnapshot) -> None:
        """Carry out the actions planned from ``observed``. Failures are stored, not raised."""
        groups: dict[Name, list[Action]] = {}
        for action in actions:
            groups.setdefault(action.of, []).append(action)
        await asyncio.gather(*(self._group(name, todo, observed) for name, todo in groups.items()))
        existing = {rosproxy.id for rosproxy in observed.rosproxies} | set(observed.unusable)
        self.failures = {name: errors for name, errors in self.failures.items() if name in existing}
        self.problems = {name: p for name, p in self.problems.items() if name in existing}
        self._retired &= {proxy.pod.uid for proxy in observed.proxies}
        self._stale &= _uids(observed)

    async def _group(self, name: Name, actions: list[Action], observed: ClusterSnapshot) -> None:
        changes = [a for a in actions if not isinstance(a, PatchStatus | Emit)]
        outcomes = [(_subject(action), await self._perform(action, observed)) for action in changes]
        failures = {id: text for id, text in outcomes if text is not None}
        if changes:
            self.failures = {**self.failures, name: failures}
        for action in actions:
            if isinstance(action, PatchStatus):
                error = await self._perform(action, observed)
                self.problems.pop(name, None)
                if error is not None:
                    text = f"the operator can't write the status: {error}"
                    self.problems[name] = Problem(
                        f"rosproxy {name}", text, reason="StatusNotWritten"
                    )
        # A Normal Event reports that an action was done. An Emit does not name the action, so after
        # any failure the operator makes no Normal Event.
        emits = [action for action in actions if isinstance(action, Emit)]
        wanted = [emit for emit in emits if not (failures and emit.type == "Normal")]
        await asyncio.gather(*(self._perform(emit, observed) for emit in wanted))

    async def _perform(self, action: Action, observed: ClusterSnapshot) -> str | None:
        """Carry out an action. Return the error.

        None if the action succeeded, was postponed, or had nothing left to do.
        """
        quiet = isinstance(action, PatchStatus | Emit)
        self.busy += 1
        try:
            retires = isinstance(action, DeleteProxy) and action.retire
            if retires and not await self._is_retired(action, observed):
                return None
            async with self._room:
                await in_thread(self._call_api, action, observed)
        except StateChanged as error:
            log.debug("%s: postponed: %s has changed meanwhile", describe(action), error)
            self._doubt(_uid(action))
            return None
        except NotLeading:
            return None  # the leader acts, or this operator in a later term
        except _nothing_left(action) as error:
            log.debug("%s: nothing to do: %s", describe(action), error)
            return None
        except ApiError as error:
            text = str(error)
        except Exception as error:  # a bug must not stop the other actions
            log.exception("action failed by an internal error: %s", describe(action))
            text = f"the operator failed: {error!r}"
        else:
            self._stale.discard(_uid(action))
            level = logging.DEBUG if quiet else logging.INFO
            log.log(level, "%s", describe(action), extra=_log_fields(action))
            self._counted(action, "ok")
            return None
        finally:
            self.busy -= 1
        previous = self.failures.get(action.of, {}).get(_subject(action))
        is_reported = text == previous or isinstance(action, PatchStatus)
        level = logging.DEBUG if is_reported else logging.WARNING
        log.log(level, "%s: %s", describe(action), text, extra=_log_fields(action))
        self._counted(action, "failed")
        return text

    def _doubt(self, uid: str) -> None:
        """Note that an object differs from the watched state. The second time, call ``doubted``.

        A first difference may come from a watch that lags.
        """
        if uid in self._stale:
            self._stale.clear()
            self._doubted()
        else:
            self._stale.add(uid)

    async def _is_retired(self, action: Action, observed: ClusterSnapshot) -> bool:
        """Whether a proxy has unregistered its nodes, or has failed to do so.

        If not, and if this operator leads, start a task that retires and deletes the proxy. No task
        starts if `confirm` raises StateChanged or ApiError.
        """
        assert isinstance(action, DeleteProxy)  # noqa: S101 - only a proxy retires
        if action.uid in self._retired:
            return True
        if not self._api.gate.open():  # a call to the proxy itself does not pass the gate
            return False
        if action.uid not in self._retiring:
            self._retiring.add(action.uid)
            try:
                async with self._room:
                    await in_thread(confirm, self._api, action, observed)
            except BaseException:
                self._retiring.discard(action.uid)
                raise
            self._tasks.spawn(self._retire(action, observed), f"retiring {action.id}")
        return False

    def _call_api(self, action: Action, observed: ClusterSnapshot) -> None:
        api = self._api
        match action:
            case Creation():
                _create(api, _PATHS[action.kind], action.body)
            case Deletion():
                version = confirm(api, action, observed)
                api.delete(_PATHS[action.kind], action.id, action.uid, version)
            case EvictPod():
                confirm(api, action, observed)
                api.evict(action.id, action.uid)
            case SetImage():
                # A JSON patch names a container only by index, so test the name first.
                container = "/spec/containers/0"
                name_test = {"op": "test", "path": f"{container}/name", "value": CONTAINER}
                image = {"op": "replace", "path": f"{container}/image", "value": action.image}
                api.patch("pods", action.id, [_uid_test(action.uid), name_test, image])
            case SetPolicy():
                spec = {"op": "replace", "path": "/spec", "value": action.spec}
                api.patch(POLICIES, action.id, [_uid_test(action.uid), spec])
            case PatchStatus():
                # `add` also replaces, and works without a former status (RFC 6902, section 4.1).
                status = {"op": "add", "path": "/status", "value": action.status}
                api.patch(f"{PLURAL}/status", action.of, [_uid_test(action.uid), status])
            case Emit():
                _emit(api, action)

    async def _retire(self, action: DeleteProxy, observed: ClusterSnapshot) -> None:
        """Let a proxy unregister its nodes, for `RETIREMENT_TIMEOUT_S` at most. Then delete it."""
        fields = _log_fields(action)
        try:
            proxy = next((p for p in observed.proxies if p.pod.uid == action.uid), None)
            if proxy is not None and proxy.pod.ip:
                async with asyncio.timeout(RETIREMENT_TIMEOUT_S):
                    token = token_for(proxy, observed.key)
                    answer = await self._proxies.retire(address_of(proxy), token)
                log.info("nodes unregistered: proxy %s, %s", action.id, answer, extra=fields)
        except (ProxyError, TimeoutError) as error:
            reason = str(error) or f"no answer in {RETIREMENT_TIMEOUT_S:g} s"
            text = "nodes not unregistered at the master: proxy %s: %s"
            log.info(text, action.id, reason, extra=fields)
        finally:
            self._retired.add(action.uid)  # delete the proxy also after a failure
            self._retiring.discard(action.uid)
            await self._perform(action, observed)


def _uid_test(uid: str) -> Json:
    """Return an operation of a JSON patch that fails if the object now has another uid."""
    return {"op": "test", "path": "/metadata/uid", "value": uid}


def describe(action: Action) -> str:
    """Return a line of text for an action."""
    match action:
        case Creation():
            return f"create {action.kind} {_subject(action)}"
        case Deletion():
            return f"delete {action.kind} {action.id}: {action.why}"
        case SetImage() | SetPolicy() | EvictPod():
            return _change_line(action)
        case PatchStatus():
            return f"write status of RosProxy {action.of}"
        case Emit():
            return f"event for {action.of}: {action.reason}: {action.message}"


def _change_line(action: SetImage | SetPolicy | EvictPod) -> str:
    if isinstance(action, SetPolicy):
        return f"correct NetworkPolicy {action.id}"
    if isinstance(action, EvictPod):
        return f"evict Pod {action.id}: {action.why}"
    return f"set image of Pod {action.id} to {action.image}"


def _subject(action: Action) -> Name:
    """Return the name of the object that an action is about."""
    match action:
        case Creation():
            return name_of(action.body["metadata"])
        case ObjectAction():
            return action.id
        case _:
            return action.of


def _uid(action: Action) -> str:
    """Return the uid of the object that an action changes; empty for a new object or an Event."""
    return action.uid if isinstance(action, ObjectAction) else ""


def _uids(observed: ClusterSnapshot) -> set[str]:
    """Return the uids of all objects that the operator may change or delete."""
    services = {service.uid for service in observed.all_services}
    policies = {policy.uid for policy in observed.policies.values()}
    return services | policies | {pod.uid for pod in observed.pods}


def _log_fields(action: Action) -> dict[str, str]:
    """Return extra fields of a log line: the proxy's pod, if the action is about a proxy."""
    of_proxy = isinstance(action, CreateProxy | DeleteProxy | SetImage)
    return {"proxy": str(_subject(action))} if of_proxy else {}


def _nothing_left(action: Action) -> tuple[type[ApiError], ...]:
    """Return the errors after which nothing is left to do.

    The object or the namespace is gone, or another object has the name now.
    """
    if isinstance(action, ObjectAction | PatchStatus):
        return ApiNotFound, ApiConflict
    return (ApiNotFound,)


def _create(
    api: Api, kind: str, body: Json, pauses: Sequence[float] = ADDRESS_RETRY_PAUSES_S
) -> None:
    """Create an object, unless the object exists.

    If the API server refuses the former address of a Service, try again after each of ``pauses``.
    Then create the Service with a new address. Raises ApiError.
    """
    try:
        api.create(kind, body)
    except ApiConflict:
        _check_ours(api, kind, body)
    except ApiInvalid as error:
        if body["spec"].get("clusterIP", _HEADLESS) == _HEADLESS:
            raise
        if pauses:
            time.sleep(pauses[0])
            return _create(api, kind, body, pauses[1:])
        text = "Service %s gets another address, since the API server refuses the former: %s"
        log.info(text, name_of(body["metadata"]), error)
        _create(api, kind, without_cluster_ip(body))


def _check_ours(api: Api, kind: str, body: Json) -> None:
    """Raise ApiConflict if an object that the operator did not create has the name already.

    An object of the operator is no error: the snapshot was a little old, or a RosProxy of the same
    name was just deleted.
    """
    try:
        metadata = submap(api.get(kind, name_of(body["metadata"])), "metadata")
    except ApiNotFound:
        return
    owners = {text_at(owner, "kind") for owner in submaps(metadata, "ownerReferences")}
    if not is_own(texts_at(metadata, "labels")) or KIND not in owners:
        raise ApiConflict(f"a {body.get('kind')} of this name exists already that {NOT_OURS}")


def _emit(api: Api, event: Emit) -> None:
    """Create an Event, or increase the count of an existing Event."""
    now = time.time()
    body = event_body(event, now)
    try:
        api.create("events", body)
    except ApiConflict:
        id = name_of(body["metadata"])
        operations = count_patch(api.get("events", id), now)
        if operations:
            api.patch("events", id, operations)
