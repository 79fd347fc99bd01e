"""For all tests: Hypothesis draws the same examples on every machine, and a slow machine is not a failure."""

from hypothesis import settings

settings.register_profile("house", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("house")
