"""The program without its extra `instrument`: no server, no database, no signatures."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

from services.cli import INSTRUMENT_PACKAGES
from tests.simulated import small_head_toml

ROOT = Path(__file__).parents[2]
WITHOUT = f"""
import sys
from importlib.abc import MetaPathFinder

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {set(INSTRUMENT_PACKAGES)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
from services.cli import main
main(sys.argv[1:])
"""


def without_the_instrument(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", WITHOUT, *words], capture_output=True, text=True, timeout=120)


def test_the_extra_is_what_the_message_is_about() -> None:
    """Each package of the extra is among those that the message names; Starlette comes with FastAPI."""
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["instrument"]
    assert {re.split(r"[^a-z]", requirement)[0] for requirement in extra} | {"starlette"} == INSTRUMENT_PACKAGES


def test_a_scene_is_simulated_and_reconstructed_without_the_instrument(tmp_path: Path) -> None:
    scene = tmp_path / "tiny.toml"
    scene.write_text(small_head_toml("Tiny simulated head", summed=4))
    done = without_the_instrument("simulate", str(scene), "-o", str(tmp_path))
    assert done.returncode == 0, done.stderr
    files = [str(tmp_path / name) for name in ("raw.tiff", "psf.tiff", "picture.png")]
    done = without_the_instrument("reconstruct", files[0], "--psf", files[1], "-o", files[2])
    assert done.returncode == 0, done.stderr


def test_a_command_of_the_instrument_names_the_extra() -> None:
    done = without_the_instrument("run")
    assert done.returncode == 2
    assert 'pip install "diffuscope[instrument]"' in done.stderr
    assert "Traceback" not in done.stderr
