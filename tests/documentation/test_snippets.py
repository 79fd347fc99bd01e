"""The snippets of the documentation's pages run, in the order of the page, on small simulated data."""

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.project_files import BIN, ROOT, files, text

pytestmark = pytest.mark.site

INSTALLATION = ("git clone", "python3 -m venv", ". .venv/bin/activate", "pip install")  # minutes, and a network
SMALL = """
name = "Small scene"
[camera]
backend = "sim"
sensor = "quantalux"
rows = 270
cols = 480
pitch_um = 20.16
[light]
backend = "sim"
[optics]
field_deg = 33.4
[sim]
seed = 3
peak_e = 15000
"""


def snippets(page: str) -> list[tuple[str, str]]:
    """Return the fenced blocks of a page as (language, code)."""
    return [(found[1], found[2]) for found in re.finditer(r"^```(\w*)\n(.*?)^```$", text(page), re.M | re.S)]


PAGES = [
    name
    for name in files()
    if re.fullmatch(r"services/research/site/[\w-]+\.md", name)
    and {"sh", "python"} & {kind for kind, _ in snippets(name)}
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `raw.tiff`, `psf.tiff` and `truth.npy` of a small simulated scene."""
    folder = tmp_path_factory.mktemp("recording")
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    run(f"diffuscope simulate small.toml -o {folder}", folder)
    return folder


def run(script: str, folder: Path) -> str:
    """Run shell commands in a folder, with the environment's programs first, and return their output."""
    path = {"PATH": f"{BIN}:{os.environ['PATH']}", "XDG_DATA_HOME": str(folder / "data")}
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script], cwd=folder, env=os.environ | path, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{script}\n{done.stdout}{done.stderr}"
    return done.stdout


@contextlib.contextmanager
def in_folder(folder: Path) -> Iterator[None]:
    """Run Python code as `python FILE` in a folder does: it is the current one, and modules are imported from it."""
    sys.path.insert(0, str(folder))
    try:
        with contextlib.chdir(folder):
            yield
    finally:
        sys.path.remove(str(folder))


def test_pages_have_snippets() -> None:
    assert "services/research/site/first_picture.md" in PAGES


@pytest.mark.parametrize("page", PAGES)
def test_the_snippets_of_a_page_run(page: str, recording: Path, tmp_path: Path) -> None:
    """Every `sh` and `python` block runs in a folder with a recording and the folders of the repository."""
    for file in ("raw.tiff", "psf.tiff", "truth.npy"):
        (tmp_path / file).symlink_to(recording / file)
    for folder in ("device", "hardware", "services"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    names: dict[str, object] = {"__name__": "__main__"}
    for language, code in snippets(page):
        if language == "sh":
            lines = [line for line in code.splitlines() if not line.startswith(INSTALLATION)]
            run("\n".join(lines), tmp_path)
        elif language == "python":
            with in_folder(tmp_path):
                exec(compile(code, page, "exec"), names)


def test_the_readme_s_two_examples_give_one_picture(tmp_path: Path) -> None:
    """The command's picture has the correlation with the truth that each picture of the Python example has."""
    (tmp_path / "out").mkdir()
    shell, code = (
        next(found for _, found in snippets("README.md") if word in found) for word in ("simulate", "import")
    )
    commands = [line for line in shell.splitlines() if line.startswith("diffuscope")]
    run("\n".join(commands).replace("picture.png", "picture.npy"), tmp_path)
    names: dict[str, Any] = {"__name__": "__main__"}
    with in_folder(tmp_path):
        exec(compile(code, "README.md", "exec"), names)
    truth = names["scene"].truth
    lit = truth > 0
    pictures = (
        np.load(tmp_path / "out" / "picture.npy"),
        names["made"].picture,
        names["again"](names["scene"].raw).picture,
    )
    found = [np.corrcoef(one[lit], truth[lit])[0, 1] for one in pictures]
    assert found[0] > 0.9
    assert found == pytest.approx([found[0]] * 3, abs=1e-3)
