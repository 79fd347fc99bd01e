"""A second host on this machine: a network namespace with one link to this one. Needs root."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

SPACE, HERE, THERE = "diffuscope-tablet", "10.77.0.1", "10.77.0.2"
OURS, THEIRS = "dsc-here", "dsc-there"
IN_SPACE = ("ip", "netns", "exec", SPACE)  # prefix of a command that runs on the other host


def sh(*words: str) -> None:
    """Run a command, which must not fail."""
    subprocess.run(words, check=True, capture_output=True)


def missing() -> str:
    """Return why no namespace can be made here, "" if one can."""
    if os.geteuid() != 0:
        return "a network namespace needs root"
    if shutil.which("ip") is None:
        return "ip (iproute2) is not installed"
    made = subprocess.run(["unshare", "--net", "true"], check=False, capture_output=True, text=True)
    return "" if made.returncode == 0 else f"no network namespace: {made.stderr.strip()}"


@contextmanager
def namespace() -> Iterator[None]:
    """Create a second host on this machine, with one link to it."""
    subprocess.run(["ip", "netns", "del", SPACE], check=False, capture_output=True)
    sh("ip", "netns", "add", SPACE)
    try:
        sh("ip", "link", "add", OURS, "type", "veth", "peer", "name", THEIRS, "netns", SPACE)
        sh("ip", "addr", "add", f"{HERE}/24", "dev", OURS)
        sh("ip", "link", "set", OURS, "up")
        for words in (
            ["addr", "add", f"{THERE}/24", "dev", THEIRS],
            ["link", "set", THEIRS, "up"],
            ["link", "set", "lo", "up"],
        ):
            sh("ip", "-n", SPACE, *words)
        yield
    finally:
        subprocess.run(["ip", "netns", "del", SPACE], check=False, capture_output=True)
