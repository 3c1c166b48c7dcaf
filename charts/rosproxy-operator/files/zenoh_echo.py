"""The session in a labelled pod that answers each question with the name of the cluster's node.

This is no node of ROS, but a session of zenoh with the variable and a key as rmw_zenoh has them. So
the image of the proxy suffices.
"""

import os
import sys
import threading

import zenoh

VARIABLE = "ZENOH_CONFIG_OVERRIDE"
KEY = "87/%s/std_srvs::srv::dds_::Trigger_/RIHS01_0" % os.environ["NODE_NAME"]


def open_session():
    """Return a session with the variable of the pod. Waits for the proxy without end."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    for pair in os.environ[VARIABLE].split(";"):
        key, _, value = pair.partition("=")
        config.insert_json5(key, value)
    return zenoh.open(config)


if __name__ == "__main__":
    if not os.environ.get(VARIABLE):
        sys.exit("this pod was not wired at admission: the operator's webhook did not answer")
    print("the variable is", os.environ[VARIABLE], flush=True)
    session = open_session()
    answers = session.declare_queryable(KEY, lambda q: q.reply(KEY, os.environ["ON_NODE"]))
    threading.Event().wait()
