"""Hypothesis profile of all tests: the same examples on every machine, and no deadline per example."""

from hypothesis import settings

settings.register_profile("project", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("project")
