"""How hard hypothesis tries: `pytest --hypothesis-profile=thorough tests/unit` for long."""

from hypothesis import settings

settings.register_profile("quick", max_examples=100, deadline=None)
settings.register_profile("thorough", max_examples=3000, deadline=None)
settings.load_profile("quick")
