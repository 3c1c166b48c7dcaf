"""The program that runs the proxy's zenoh routers, as a child of the proxy.

The routers are a library in Rust. A crash or a hang of the library ends this process, and leaves
the proxy alone. The proxy then starts the process again (`rosproxy.zenoh.router_supervisor`).

Each line of standard input is JSON: a revision, and a list of `RouterConfig`. With each further
line, the process restarts the routers with changed configurations, and leaves the other routers
alone. A line ``{"end": [[ADDRESS, PORT]]}`` ends connections. Standard output gets a `Report` each
second, and at once after a line. If a router cannot be opened or does not answer, the last report
has the error, and the process ends.

Nodes wait for the process, so the process loads little: msgspec would take as long as all the rest.
"""

import contextlib
import ctypes
import json
import os
import queue
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

import zenoh

from rosproxy.zenoh.outside_routers import OutsideRouters
from rosproxy.zenoh.protocol.library_log import LEVELS
from rosproxy.zenoh.protocol.liveliness import ALL_TOKENS, MOST_TOKENS, is_kept

REPORT_INTERVAL_S = 1.0
REOPEN_PAUSE_S = 0.5
"""Seconds between the end of routers and the start of their successors. Other routers recompute
their routes 0.1 s after a change. If a router ends and its successor connects within this time,
they never send their subscriptions to the successor (zenoh 1.7.2, TREES_COMPUTATION_DELAY_MS)."""
LINKING_TIMEOUT_S = 2.0
"""Seconds in which the hub links to a router. The hub dials a lost router again after 1 s."""
LINKING_INTERVAL_S = 0.05
"""Seconds between two looks at the links of the hub."""
LINKING_PAUSE_S = 0.1
"""Seconds in which zenoh notes a new link at both ends."""
RECEIVING_THREADS = 128
"""Threads that receive for all routers. zenoh has two. A message that may not be dropped holds its
thread while a queue is full, in each router on its way. With two threads, one publisher at full
rate, or one subscriber that hangs, stops the messages of all containers (zenoh 1.7.2)."""
ANSWER_TIMEOUT_S = 1.0
"""Seconds in which other programs may answer in place of a router, which answers at once."""
_PR_SET_PDEATHSIG = 1
_NO_LINE = "\n"


class Tokens:
    """The liveliness tokens of the graph, as a router sees them."""

    def __init__(self) -> None:
        self._keys: set[str] = set()
        self._changed = True
        self.left_out = 0

    def take(self, sample: Any) -> None:
        """Note that a token appears or ends. A thread of zenoh calls this."""
        key = str(sample.key_expr)
        is_known = key in self._keys
        if sample.kind == zenoh.SampleKind.DELETE:
            self._keys.discard(key)
            self.left_out = max(self.left_out - (not is_known), 0)
        elif len(self._keys) < MOST_TOKENS and is_kept(key):
            self._keys.add(key)
        else:
            self.left_out += not is_known
        self._changed = True

    def take_change(self) -> bool:
        """Return whether a token has changed since the last call."""
        changed = self._changed
        self._changed = False
        return changed

    def keys(self) -> set[str]:
        """All tokens."""
        return self._keys.copy()


class Router:
    """An open router. The hub, and each router with access control, has the tokens of the graph.

    Access control keeps some tokens from the hub. ``most_sessions`` is 0 if not configured. Raises
    zenoh.ZError.
    """

    def __init__(self, config: Mapping[str, str], *, is_hub: bool) -> None:
        self.config = config
        self.most_sessions = int(config.get("transport/unicast/max_sessions", 0))
        self.session = open_router(config)
        self.tokens = Tokens()
        if is_hub or "access_control" in config:
            # The subscriber ends with its object, which has to have a name.
            self._subscriber = self.session.liveliness().declare_subscriber(
                ALL_TOKENS, self.tokens.take, history=True
            )


class Routers:
    """The routers of the latest configurations; the last is the hub."""

    def __init__(self) -> None:
        self._routers: list[Router] = []
        self._left_out = 0
        self._outside = OutsideRouters()

    def use(self, configs: Sequence[Mapping[str, str]]) -> None:
        """Open the routers with new or changed configurations.

        Raises zenoh.ZError if a router cannot be opened, ValueError as `_wait_for_links` does.
        """
        changed = [
            index
            for index, config in enumerate(configs)
            if index >= len(self._routers) or self._routers[index].config != config
        ]
        ended = [self._routers[index] for index in changed if index < len(self._routers)]
        if ended:
            self._wait_for_links(ended)
            for router in ended:
                router.session.close()
            time.sleep(REOPEN_PAUSE_S)
        last = len(configs) - 1
        opened = {index: Router(configs[index], is_hub=index == last) for index in changed}
        kept = dict(enumerate(self._routers))
        self._routers = [(kept | opened)[index] for index in range(len(configs))]

    def _wait_for_links(self, routers: Sequence[Router]) -> None:
        """Wait until the hub is linked to each of these routers.

        A router that ends while the hub dials it may keep the link, and the hub may never dial the
        port again (zenoh 1.7.2). Then no message of the container passes any more.

        Raises ValueError after LINKING_TIMEOUT_S. The next process needs no change.
        """
        hub = self._routers[-1]
        others = {str(r.session.info.zid()) for r in routers if r is not hub}
        deadline = time.monotonic() + LINKING_TIMEOUT_S
        while not others <= {str(zid) for zid in hub.session.info.routers_zid()}:
            if time.monotonic() > deadline:
                raise ValueError(f"the hub has no link to a router for {LINKING_TIMEOUT_S:g} s")
            time.sleep(LINKING_INTERVAL_S)
        time.sleep(LINKING_PAUSE_S)

    def report(self) -> dict[str, Any]:
        """The fields of a report. Raises ValueError if a router does not answer."""
        described = [
            {**describe(router.session), "most_sessions": router.most_sessions}
            for router in self._routers
        ]
        self._outside.look(self._routers[-1].session, described, time.monotonic())
        by_router = [router.tokens for router in self._routers]
        keys = None
        # A list, because `take_change` has to be called for every router.
        changes = [tokens.take_change() for tokens in by_router]
        if any(changes):
            union = sorted(set[str]().union(*(tokens.keys() for tokens in by_router)))
            keys = union[:MOST_TOKENS]
            self._left_out = len(union) - len(keys)
        left_out = max(tokens.left_out for tokens in by_router) + self._left_out
        return {
            "routers": described,
            "tokens": keys,
            "tokens_left_out": left_out,
            "outside": self._outside.report(),
        }


def open_router(config: Mapping[str, str]) -> Any:
    """A router that runs. Raises zenoh.ZError."""
    made = zenoh.Config()
    for key, value in config.items():
        made.insert_json5(key, value)
    return zenoh.open(made)


def describe(router: Any) -> dict[str, Any]:
    """The zenoh ID, the sessions and the addresses of a router, from the router's admin space.

    Every program in the zenoh network can answer for this key. The answer of the router itself
    comes during the call, on the thread of the call. The answers of others come on other threads.

    Raises ValueError if the router does not answer.
    """
    thread = threading.get_ident()
    answers: list[Any] = []

    def take(reply: Any) -> None:
        if threading.get_ident() == thread and reply.ok is not None:
            answers.append(reply.ok)

    router.get(
        f"@/{router.info.zid()}/router",
        zenoh.handlers.Callback(take, lambda: None, indirect=False),
        target=zenoh.QueryTarget.ALL,  # by default, another program could answer alone
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=ANSWER_TIMEOUT_S,
    )
    if not answers:
        raise ValueError("a router does not describe itself")
    answer = json.loads(answers[0].payload.to_bytes())
    return {key: answer[key] for key in ("zid", "sessions", "locators")}


def report(output: TextIO, **fields: Any) -> None:
    """Write a report. Raises BrokenPipeError if the proxy has ended."""
    print(json.dumps(fields), file=output, flush=True)


def end_connections(remotes: Sequence[Sequence[Any]]) -> None:
    """End the connections of this process to addresses. zenoh has no call for that.

    zenoh closes a connection while other connections wait. Without this value of SO_LINGER, that
    takes ten seconds if the other end does not answer.
    """
    for name in os.listdir("/proc/self/fd"):
        try:
            copy = os.dup(int(name))
        except OSError:  # closed meanwhile
            continue
        try:
            connection = socket.socket(fileno=copy)
        except OSError:  # no socket
            os.close(copy)
            continue
        with connection, contextlib.suppress(OSError):  # no connection
            if [*connection.getpeername()[:2]] in remotes:
                reset_at_once = struct.pack("ii", 1, 0)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset_at_once)
                connection.shutdown(socket.SHUT_RDWR)


def read_lines(lines: "queue.SimpleQueue[str]") -> None:
    """Put each line of standard input into a queue; an empty text at the end."""
    while line := sys.stdin.readline():
        lines.put(line)
    lines.put("")


def run(lines: "queue.SimpleQueue[str]", output: TextIO) -> None:
    """Run the routers of each line, and report, without end.

    Raises zenoh.ZError if a router cannot be opened, ValueError if a router does not answer or the
    input has ended, and BrokenPipeError.
    """
    routers = Routers()
    revision = 0
    line = lines.get()
    while True:
        if line != _NO_LINE:
            # The empty text at the end of the input is no JSON. So ValueError ends the process.
            message = json.loads(line)
            if "end" in message:
                end_connections(message["end"])
            else:
                routers.use(message["routers"])
                revision = message["revision"]
        report(output, revision=revision, **routers.report())
        try:
            line = lines.get(timeout=REPORT_INTERVAL_S)
        except queue.Empty:
            line = _NO_LINE


def serve(lines: "queue.SimpleQueue[str]", output: TextIO) -> None:
    """Run the routers until an error or the end of the proxy. The last report has the error."""
    try:
        run(lines, output)
    except (zenoh.ZError, ValueError) as error:
        report(output, error=str(error))
    except BrokenPipeError:
        pass  # the proxy has ended
    except BaseException as error:  # the library's PanicException is no Exception
        report(output, error=f"the zenoh library has failed: {error}")


def main() -> int:
    """Run the routers until an error, or the end of the proxy. Return the exit status."""
    # The kernel ends this process with the proxy, whose next process needs the ports.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # Ctrl-C goes to all programs of a terminal; the proxy ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Only reports go to the proxy, whatever the library prints.
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    zenoh.init_log_from_env_or(LEVELS)
    # zenoh reads this once, when it starts its threads (zenoh-runtime/src/lib.rs).
    os.environ["ZENOH_RUNTIME"] = f"(rx: (worker_threads: {RECEIVING_THREADS}))"
    lines = queue.SimpleQueue[str]()
    threading.Thread(target=read_lines, args=[lines], daemon=True).start()
    serve(lines, output)
    return 1


if __name__ == "__main__":
    # zenoh waits for its threads at the end, which may hang.
    os._exit(main())
