"""What kopf calls: events only wake the operator, and pods are wired at admission.

kopf writes nothing to any object for ``on.event``: no annotation, no finalizer.
"""

from collections.abc import Callable, MutableMapping
from typing import Any, Protocol

import kopf

from rosproxy_operator.kubernetes.event_filter import EventFilter
from rosproxy_operator.kubernetes.resources.names import GROUP, INJECT, PLURAL, VERSION
from rosproxy_operator.kubernetes.webhook.injector import Injector

WIRE = "wire"
"""The handler's id, and so the path of the webhook."""


class Wakeable(Protocol):
    """What events and probes are told to."""

    event_filter: EventFilter

    def wake(self) -> None:
        """Let it look again soon."""

    def dead(self) -> str | None:
        """Why it is not alive; None if it is."""


class NotAlive(Exception):
    """The operator is not alive."""


def registry(
    controller: Wakeable,
    injector: Injector | None,
    configure: Callable[[kopf.OperatorSettings], None],
) -> kopf.OperatorRegistry:
    """All handlers; no webhook without an ``injector``. ``configure`` is called at start."""
    handlers = kopf.OperatorRegistry()
    _lifetime(handlers, controller, configure)
    _events(handlers, controller)
    if injector is not None:
        _webhook(handlers, injector)
    return handlers


def _lifetime(
    handlers: kopf.OperatorRegistry,
    controller: Wakeable,
    configure: Callable[[kopf.OperatorSettings], None],
) -> None:
    @kopf.on.startup(registry=handlers, id="startup")
    async def startup(settings: kopf.OperatorSettings, **_: Any) -> None:
        configure(settings)

    # As long as there are no credentials, kopf is not to end for it.
    kopf.on.login(registry=handlers, backoff=5.0)(kopf.login_via_client)

    # Otherwise it would be tried again for a minute before the probe is answered.
    @kopf.on.probe(registry=handlers, id="alive", errors=kopf.ErrorsMode.PERMANENT)
    async def alive(**_: Any) -> str:
        reason = controller.dead()
        if reason:
            raise NotAlive(reason)
        return "ok"

    @kopf.on.cleanup(registry=handlers, id="cleanup")
    async def cleanup(**_: Any) -> None:
        controller.wake()  # what is missed while nobody watches is found by looking


def _events(handlers: kopf.OperatorRegistry, controller: Wakeable) -> None:
    event_filter = controller.event_filter

    def on(matters: Callable[[str | None, Any], bool], *resource: str) -> None:
        @kopf.on.event(*resource, registry=handlers, id=resource[-1])
        async def happened(event: kopf.RawEvent, **_: Any) -> None:
            if matters(event["type"], event["object"]):
                controller.wake()

    on(event_filter.rosproxy, GROUP, VERSION, PLURAL)
    on(event_filter.pod, "", "v1", "pods")
    on(event_filter.node, "", "v1", "nodes")
    on(event_filter.service, "", "v1", "services")


def _webhook(handlers: kopf.OperatorRegistry, injector: Injector) -> None:
    @kopf.on.mutate(
        "",
        "v1",
        "pods",
        id=WIRE,
        registry=handlers,
        operations=["CREATE"],
        labels={INJECT: kopf.PRESENT},
        ignore_failures=True,
    )
    async def wire(
        body: kopf.Body,
        patch: kopf.Patch,
        warnings: list[str],
        dryrun: bool,
        **_: Any,
    ) -> None:
        wiring = await injector.wiring(_plain(body), dryrun)
        warnings.extend(wiring.warnings)
        if wiring.spec is not None:
            patch["spec"] = dict(wiring.spec)
        if wiring.annotations:
            patch.metadata["annotations"] = dict(wiring.annotations)


def _plain(body: kopf.Body) -> MutableMapping[str, Any]:
    """The object as it was sent: kopf's own is a view whose parts are no dictionaries."""
    return dict(body)
