"""How the rules of the house look at files: what there is, what it says, and how a rule is judged."""

import ast
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
ROOMS = ("device", "services", "web", "systemd", "tests", "hardware")
BESIDE = {
    ".ci", ".gitignore", "CHANGELOG.md", "LICENSE", "Makefile", "README.md", "pyproject.toml", "requirements.lock",
}  # fmt: skip

Offence = tuple[int, str, str]
Finder = Callable[[str], Iterable[Offence]]


@cache
def files() -> tuple[str, ...]:
    """What git holds or would hold, and what is there; vendored code belongs to others."""
    git = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(git, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    return tuple(sorted(n for n in names if not n.startswith("web/vendor/") and (ROOT / n).is_file()))


@cache
def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@cache
def parsed(source: str) -> ast.Module:
    return ast.parse(source)


@cache
def nodes(source: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(parsed(source)))


def python(*rooms: str) -> list[str]:
    return [name for name in files() if name.endswith(".py") and name.startswith(rooms)]


def judge(finder: Finder, names: Iterable[str], allowed: Mapping[str, str], rule: str) -> None:
    """Fail with every offence that no exception covers, and with every exception that nothing needs any more."""
    found = [(f"{name}: {key}", line, what) for name in names for line, key, what in finder(text(name))]
    bad = [f"{key} (line {line}): {what}" for key, line, what in found if key not in allowed]
    assert not bad, "\n".join([rule, *bad])
    assert all(len(reason) > 20 for reason in allowed.values()), "an exception carries its reason"
    assert set(allowed) <= {key for key, _, _ in found}, f"no longer needed: {set(allowed) - {k for k, _, _ in found}}"
