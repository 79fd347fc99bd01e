"""Files of the repository for the architecture tests: names, texts, syntax trees, and the check of a rule."""

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
TOP_FOLDERS = ("device", "services", "web", "systemd", "tests", "hardware")
TOP_FILES = {
    ".ci",
    ".github",
    ".gitignore",
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "LICENSE",
    "LICENSES",
    "Makefile",
    "README.md",
    "REUSE.toml",
    "pyproject.toml",
    "requirements.lock",
}

Violation = tuple[int, str, str]
Finder = Callable[[str], Iterable[Violation]]


@cache
def files() -> tuple[str, ...]:
    """Return the tracked and the untracked, not ignored files, without vendored code and encrypted golden files."""
    git = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(git, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    others = re.compile("web/vendor/|.*/kept/data/")
    return tuple(sorted(n for n in names if not others.match(n) and (ROOT / n).is_file()))


@cache
def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


@cache
def parsed(source: str) -> ast.Module:
    return ast.parse(source)


@cache
def nodes(source: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(parsed(source)))


def python_files(*prefixes: str) -> list[str]:
    return [name for name in files() if name.endswith(".py") and name.startswith(prefixes)]


def check_rule(finder: Finder, names: Iterable[str], allowed: Mapping[str, str], rule: str) -> None:
    """Fail with every violation without an exception, and with every exception without a violation."""
    found = [(f"{name}: {key}", line, what) for name in names for line, key, what in finder(text(name))]
    bad = [f"{key} (line {line}): {what}" for key, line, what in found if key not in allowed]
    assert not bad, "\n".join([rule, *bad])
    assert all(len(reason) > 20 for reason in allowed.values()), "an exception carries its reason"
    assert set(allowed) <= {key for key, _, _ in found}, f"no longer needed: {set(allowed) - {k for k, _, _ in found}}"
