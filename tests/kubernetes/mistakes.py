"""Users' mistakes: the doctor names each mistake, and the doctor's fix works to the letter."""

import json
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.docker.engine import wait_until
from tests.docker.images import ROS2
from tests.docker.nodes import Log, node_command
from tests.docker.ros2 import command
from tests.kubernetes import api
from tests.kubernetes.api import Json
from tests.kubernetes.cluster.control_plane import kubectl
from tests.kubernetes.pods import INJECT, Namespace, unique
from tests.kubernetes.robot import Robot
from tests.kubernetes.ros2 import Robot2
from tests.kubernetes.rosproxies import RosProxy, events, rosproxy
from tests.kubernetes.test_doctor import doctor
from tests.kubernetes.traffic import START

APP = "app"
TOLD_WITHIN = 100.0
"""Seconds until a mistake must be told: a pod without a RosProxy is told after a minute."""
RESTART = r"rollout restart \S+"
EDIT_APP = r"edit deployment/\S+"
EDIT_ROSPROXY = r"edit rosproxy \S+"
"""Patterns of the commands in the doctor's output, after ``kubectl -n NAMESPACE``."""
_OF_DOCKER = re.compile(r"docker|--(master-uri|advertise-host|port-range|data-plane)", re.I)


@dataclass(frozen=True)
class Site:
    """A namespace with a Deployment ``app`` and a RosProxy ``robot``, and the robot outside.

    The pod of the Deployment publishes ``topic``, of ROS 2 if there is a ``robot2``.
    """

    net: Namespace
    robot: Robot
    robot2: Robot2 | None = None
    topic: str = field(default_factory=lambda: f"/{unique('site').replace('-', '_')}")

    @property
    def rosproxy(self) -> RosProxy:
        return RosProxy(self.net.name, "robot")

    @property
    def node(self) -> str:
        return self.topic.removeprefix("/")

    def talker(self, word: str = "inside", node: str = "") -> tuple[str, ...]:
        """The command that publishes a word."""
        name = node or self.node
        if self.robot2:
            return command("jazzy", "pub", self.topic, "--word", word, "--name", name)
        options = ("--topic", self.topic, "--word", word, f"__name:={name}")
        return node_command("roscpp", "pub", *options)

    @contextmanager
    def listener(self, domain: int = 0) -> Iterator[Log]:
        """A subscriber on the robot."""
        name = f"listener_of_{self.node}"
        if self.robot2:
            try:
                yield self.robot2.node("jazzy", "sub", self.topic, domain=domain, name=name)
            finally:
                self.robot2.end_all()
            return
        try:
            yield self.robot.node(name, "roscpp", "sub", "--topic", self.topic)
        finally:
            self.robot.end(name)

    def create_rosproxy(self, **spec: Any) -> None:
        ros2 = str(spec.get("ros")) == "2"
        master = {} if ros2 else {"master": {"uri": self.robot.master_uri}}
        rosproxy(self.net.name, **{**master, "ports": 16 if ros2 else 8, **spec})

    def pod_spec(self, **template: Any) -> Json:
        """The spec of the Deployment's pods."""
        words = template.pop("command", None) or self.talker()
        image = {"image": ROS2} if self.robot2 else {}
        spec: Json = self.net.pod_body("unused", *words, **{**image, **template})["spec"]
        return spec

    def create_app(self, **template: Any) -> None:
        """Create the Deployment. ``template`` are properties of the pods besides the label."""
        labels = {"app": APP, **template.pop("labels", {INJECT: "true"})}
        metadata = {"labels": labels, "annotations": template.pop("annotations", {})}
        body = {
            "apiVersion": "apps/v1", "kind": "Deployment",
            "metadata": {"name": APP, "namespace": self.net.name},
            # A master keeps the last node of a name alone, so the former pod ends first.
            "spec": {"replicas": 1, "selector": {"matchLabels": {"app": APP}},
                     "strategy": {"type": "Recreate"},
                     "template": {"metadata": metadata, "spec": self.pod_spec(**template)}},
        }  # fmt: skip
        api.create(body)

    def edit_app(self, **spec: Any) -> None:
        """Change the spec of the pods as a user that makes a mistake."""
        api.patch("deployments", self.net.name, APP, {"spec": {"template": {"spec": spec}}})

    def restart_app(self) -> None:
        kubectl("-n", self.net.name, "rollout", "restart", f"deployment/{APP}")

    def create(self, kind: str, name: str, **spec: Any) -> None:
        metadata = {"name": name, "namespace": self.net.name}
        api.create({"apiVersion": "v1", "kind": kind, "metadata": metadata, "spec": spec})

    def texts(self, reason: str) -> list[str]:
        """The texts with this reason, in Events of pods and RosProxies, and in conditions."""
        conditions = self.rosproxy.status.get("conditions", [])
        own = self.rosproxy.events
        pods = [
            event
            for pod in self.net.pods()
            for event in events(self.net.name, pod["metadata"]["name"], "Pod")
        ]
        return [
            *(c["message"] for c in conditions if c.get("reason") == reason),
            *(event.message for event in (*own, *pods) if event.reason == reason),
        ]

    def is_well(self) -> bool:
        status = self.rosproxy.status
        now = {c["type"]: c["status"] for c in status.get("conditions", [])}
        wanted = {"Ready": "True", "Degraded": "False"}
        return status.get("nodes") == 1 and wanted.items() <= now.items()


Step = Callable[[Site], None]
Follow = Callable[[Site, str], None]
"""Follows a fix. The text has the errors of the doctor, first the error about the mistake."""


@dataclass(frozen=True)
class Cure:
    """The doctor's words about a fault, and words of the fix, both in a single error.

    ``{ns}`` stands for the namespace.
    """

    said: str
    advice: str
    follow: Follow


@dataclass(frozen=True)
class Mistake:
    """A mistake, the reason of its Event or condition, and the fixes in turn.

    Afterwards the robot hears all ``words``, in ``domain`` for ROS 2. ``is_silent``: the robot
    hears nothing before the last fix. ``undo`` removes remainders outside of the namespace.
    """

    make: Step
    reason: str
    cures: tuple[Cure, ...]
    undo: Step = lambda _: None
    words: tuple[str, ...] = ("inside",)
    domain: int = 0
    is_silent: bool = True


def walk_through(mistake: Mistake, site: Site) -> None:
    """Make a mistake, follow the doctor, and wait until the doctor is content and all flows."""
    with site.listener(mistake.domain) as heard:
        try:
            mistake.make(site)
            wait_until(lambda: bool(site.texts(mistake.reason)), TOLD_WITHIN, lambda: _story(site))
            for cure in mistake.cures:
                said = _wait_said(site, cure)
                assert not (mistake.is_silent and heard.got()), f"a false alarm: {said}"
                cure.follow(site, said)
            wait_until(site.is_well, 90, lambda: f"the fix works: {_story(site)}")
            wait_until(
                lambda: not errors(site.net.name), 90, lambda: f"content: {errors(site.net.name)}"
            )
            fixed = time.time()
            for word in mistake.words:
                heard.wait_for(word, since=fixed, seconds=START)
        finally:
            mistake.undo(site)


def errors(namespace: str) -> list[str]:
    """The errors of the doctor, each with its fix. No fix is one for users of Docker."""
    code, found = doctor(namespace)
    texts = [f"{f['text']}\n{f['fix']}" for f in found if f["severity"] == "error"]
    assert code == bool(texts), found
    assert not [text for text in texts if _OF_DOCKER.search(text)], texts
    return texts


def _wait_said(site: Site, cure: Cure) -> str:
    """Wait until the doctor names a fault and the fix. Return the errors, that one first."""
    said, advice = (words.replace("{ns}", site.net.name) for words in (cure.said, cure.advice))
    told: list[str] = []

    def is_said() -> bool:
        found = errors(site.net.name)
        told[:] = sorted(found, key=lambda text: not (said in text and advice in text))
        return bool(told) and said in told[0] and advice in told[0]

    wait_until(is_said, 60, lambda: f"{said!r} and {advice!r} in {told}: {_story(site)}")
    return "\n".join(told)


def _story(site: Site) -> str:
    pods = [event for pod in site.net.pods() for event in _events_of(site, pod)]
    return f"{pods}\n{site.rosproxy.tell()}"


def _events_of(site: Site, pod: Json) -> list[str]:
    found = events(site.net.name, pod["metadata"]["name"], "Pod")
    return [f"{event.reason}: {event.message}" for event in found]


def run_told(site: Site, said: str, pattern: str, patch: Json | None = None) -> None:
    """Run the first command of a pattern that the doctor told. ``patch`` is what a user edits."""
    match = re.search(rf"kubectl (-n {site.net.name} )?{pattern}", said)
    assert match, f"no command {pattern!r} in: {said}"
    words = match[0].rstrip(".,;:)").split()[1:]
    if patch is None:
        kubectl(*words)
        return
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(patch, file)
        file.flush()
        editor = f"{sys.executable} {Path(__file__).with_name('editor.py')} {file.name}"
        done = kubectl(*words, env={**os.environ, "KUBE_EDITOR": editor})
    assert "edited" in done, done


def restart(site: Site, said: str) -> None:
    run_told(site, said, RESTART)


def edit_rosproxy(**spec: Any) -> Follow:
    """Edit fields of the spec. None removes a field."""
    return lambda site, said: run_told(site, said, EDIT_ROSPROXY, {"spec": spec})


def edit_template(
    labels: Json | None = None, annotations: Json | None = None, **spec: Any
) -> Follow:
    """Edit the template of the pods. None removes a label, an annotation or a field."""
    metadata = {"labels": labels or {}, "annotations": annotations or {}}
    patch = {"spec": {"template": {"metadata": metadata, "spec": spec}}}
    return lambda site, said: run_told(site, said, EDIT_APP, patch)


def by_hand(step: Step) -> Follow:
    """A fix for which the doctor has no command."""
    return lambda site, _: step(site)


def restart_as_told(site: Site) -> None:
    """Restart pods that were created before the RosProxy's Service, once this is told."""
    command = f"rollout restart deployment/{APP}"
    wait_until(
        lambda: any(command in text for text in site.texts("NotWired")), 60, "a restart is the fix"
    )
    site.restart_app()
