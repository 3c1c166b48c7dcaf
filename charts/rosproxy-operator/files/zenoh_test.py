"""The test in a labelled pod: asks a session in another pod, and waits for the answer."""

import os
import threading
import time

from echo import KEY, VARIABLE, open_session

NAMESPACE = os.environ["NAMESPACE"]
ROSPROXY = os.environ["ROSPROXY"]
ON = os.environ["ON_NODE"]
STARTED = time.monotonic()


def say(text):
    print("%6.1f s  %s" % (time.monotonic() - STARTED, text), flush=True)


def fail(what, advice):
    say("FAILED: %s. %s" % (what, advice))
    os._exit(1)  # also ends a thread that waits for the proxy


def give_up():
    fail(
        "no answer comes from the other pod",
        "While the test runs, read kubectl -n %s describe rosproxy %s. Check that pods reach the "
        "proxies at port 7448, and the proxies each other at port 7447." % (NAMESPACE, ROSPROXY),
    )


def wait_for_answer(session):
    """Return the cluster's node from which the answer comes."""
    while True:
        for answer in session.get(KEY, timeout=1.0):
            if answer.ok is not None:
                return answer.ok.payload.to_string()
        time.sleep(0.5)


if not os.environ.get(VARIABLE):
    fail("this pod was not wired at admission", "Check that the operator's webhook answers.")
say("on node %s, the variable is %s" % (ON, os.environ[VARIABLE]))
deadline = threading.Timer(float(os.environ["TIMEOUT"]), give_up)
deadline.start()
there = wait_for_answer(open_session())
deadline.cancel()
if there == ON:
    say("both pods are on node %s, so no hub was used" % ON)
say("PASSED: a question went to the pod on node %s, and the answer came back" % there)
os._exit(0)
