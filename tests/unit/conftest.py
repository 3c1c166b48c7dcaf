"""How hard hypothesis tries: `pytest --hypothesis-profile=thorough tests/unit` for long.

`make check`, which is to take less than a minute, uses the profile "brief".

In CI it tries the same examples each time, so that nobody's change fails for a bug that was there
before; on a developer's machine others each time, and what it finds is tried again first.
"""

import os

from hypothesis import HealthCheck, settings

CI = os.environ.get("CI") == "true"

ANY_SPEED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
"""A busy machine makes no test fail."""

settings.register_profile("quick", ANY_SPEED, max_examples=100, derandomize=CI)
settings.register_profile("brief", ANY_SPEED, max_examples=20, derandomize=CI)
settings.register_profile("thorough", ANY_SPEED, max_examples=3000)
settings.load_profile("quick")
