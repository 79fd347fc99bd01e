"""Lines and words of the output that depend on the load of the computer: progress after a second, compiled kernels."""

import re

PROGRESS = re.compile(r"^\w+ing\b[^:\n]*: \d+ s(?: \(compiling .*\))?\n", re.M)
COMPILED = re.compile(r", \d+\.\d s of them to compile kernels, once on this computer")


def without_progress(text: str) -> str:
    """Return the output of a command as an idle computer with compiled kernels prints it."""
    return COMPILED.sub("", PROGRESS.sub("", text))
