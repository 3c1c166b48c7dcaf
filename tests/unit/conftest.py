"""Profiles of hypothesis. For a long run: `pytest --hypothesis-profile=thorough tests/unit`.

`make check` uses the profile "brief", and takes less than a minute.

In CI hypothesis tries the same examples each time, so that no change fails for an older bug. On a
developer's machine the examples differ each time, and failed examples come first.
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
