"""How hard hypothesis tries: `pytest --hypothesis-profile=thorough tests/unit` for long.

`make check`, which is to take less than a minute, uses the profile "brief".

In CI it tries the same examples each time, so that nobody's change fails for a bug that was there
before; on a developer's machine others each time, and what it finds is tried again first.
"""

import os

from hypothesis import settings

CI = os.environ.get("CI") == "true"

settings.register_profile("quick", max_examples=100, deadline=None, derandomize=CI)
settings.register_profile("brief", max_examples=20, deadline=None, derandomize=CI)
settings.register_profile("thorough", max_examples=3000, deadline=None)
settings.load_profile("quick")
