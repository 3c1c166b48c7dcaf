"""The program that runs the proxy's zenoh routers, as a child of the proxy.

The routers are a library in Rust. A crash or a hang of the library ends this process, and leaves
the proxy alone. The proxy then starts the process again (`rosproxy.zenoh.router_supervisor`).

Standard input has a line of JSON, a list of `RouterConfig`. Standard output gets a `Report` each
second. The process ends with an error in the last report if a router cannot be opened, or does not
answer.

Nodes wait for the process, so the process loads little: msgspec would take as long as all the rest.
"""

import ctypes
import json
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

import zenoh

from rosproxy.zenoh.protocol.liveliness import ALL_TOKENS, LONGEST_TOKEN, MOST_TOKENS

REPORT_INTERVAL_S = 1.0
ANSWER_TIMEOUT_S = 5.0
"""Time in which a router has to describe itself. A router takes less than a millisecond."""
_PR_SET_PDEATHSIG = 1


class Tokens:
    """The liveliness tokens of the graph."""

    def __init__(self) -> None:
        self._keys: set[str] = set()
        self._changed = True
        self.left_out = 0

    def take(self, sample: Any) -> None:
        """Note that a token appears or ends. A thread of zenoh calls this."""
        key = str(sample.key_expr)
        is_kept = key in self._keys
        if sample.kind == zenoh.SampleKind.DELETE:
            self._keys.discard(key)
            self.left_out = max(self.left_out - (not is_kept), 0)
        elif len(self._keys) < MOST_TOKENS and len(key) <= LONGEST_TOKEN:
            self._keys.add(key)
        else:
            self.left_out += not is_kept
        self._changed = True

    def changed(self) -> list[str] | None:
        """All tokens; None if none has changed since the last call."""
        if not self._changed:
            return None
        self._changed = False
        return list(self._keys.copy())


def open_router(config: Mapping[str, str]) -> Any:
    """A router that runs. Raises zenoh.ZError."""
    made = zenoh.Config()
    for key, value in config.items():
        made.insert_json5(key, value)
    return zenoh.open(made)


def describe(router: Any) -> dict[str, Any]:
    """What a router says of itself. Raises ValueError if it does not answer."""
    for reply in router.get(f"@/{router.info.zid()}/router", timeout=ANSWER_TIMEOUT_S):
        if reply.ok is not None:
            told = json.loads(reply.ok.payload.to_bytes())
            return {"zid": told["zid"], "sessions": told["sessions"]}
    raise ValueError(f"a router does not answer within {ANSWER_TIMEOUT_S:g} s")


def report(output: TextIO, **fields: Any) -> None:
    """Write a report. Raises BrokenPipeError if the proxy has ended."""
    print(json.dumps(fields), file=output, flush=True)


def run(configs: Sequence[Mapping[str, str]], output: TextIO) -> None:
    """Run routers and report, without end. Raises zenoh.ZError, ValueError, BrokenPipeError."""
    routers = [open_router(config) for config in configs]
    tokens = Tokens()
    # The subscriber ends with its object, which has to have a name.
    _subscriber = routers[-1].liveliness().declare_subscriber(ALL_TOKENS, tokens.take, history=True)
    while True:
        described = [describe(router) for router in routers]
        changed = tokens.changed()
        report(output, routers=described, tokens=changed, tokens_left_out=tokens.left_out)
        time.sleep(REPORT_INTERVAL_S)


def main() -> int:
    """The exit status."""
    # The kernel ends this process with the proxy, whose next process needs the ports.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # Ctrl-C goes to all programs of a terminal; the proxy ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Only reports go to the proxy, whatever the library prints.
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    zenoh.init_log_from_env_or("error")
    try:
        run(json.loads(sys.stdin.readline()), output)
    except (zenoh.ZError, ValueError) as error:
        report(output, error=str(error))
    except BrokenPipeError:
        pass  # the proxy has ended
    return 1


if __name__ == "__main__":
    # zenoh waits for its threads at the end, which may hang.
    os._exit(main())
