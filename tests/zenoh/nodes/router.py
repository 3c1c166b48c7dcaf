"""A router with the defaults of rmw_zenohd: `python router.py`."""

import threading

from sessions import ROUTER, open_session

session = open_session(ROUTER)
print("router runs", flush=True)
threading.Event().wait()
