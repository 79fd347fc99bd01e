"""The program without its extras: no server, no database, no signatures; no Dask and no pyarrow."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

from services.cli import ARCHIVE_PACKAGES, INSTRUMENT_PACKAGES
from tests.simulated import small_head_toml

ROOT = Path(__file__).parents[2]
WITHOUT = f"""
import sys
from importlib.abc import MetaPathFinder

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {set(INSTRUMENT_PACKAGES | ARCHIVE_PACKAGES)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
from services.cli import main
main(sys.argv[1:])
"""


def without_the_extras(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", WITHOUT, *words], capture_output=True, text=True, timeout=120)


def test_the_extra_is_what_the_message_is_about() -> None:
    """The packages of each extra are those that the message names.

    Starlette comes with FastAPI, Dask too, and argon2 is the module of argon2-cffi.
    """
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {
        name: {re.split(r"[^a-z0-9]", requirement)[0] for requirement in extras[name]}
        for name in ("instrument", "archive")
    }
    assert named["instrument"] | {"starlette"} == INSTRUMENT_PACKAGES
    assert named["archive"] | {"dask"} == ARCHIVE_PACKAGES


def test_a_scene_is_simulated_and_reconstructed_without_the_instrument(tmp_path: Path) -> None:
    scene = tmp_path / "tiny.toml"
    scene.write_text(small_head_toml("Tiny simulated head", summed=4))
    done = without_the_extras("simulate", str(scene), "-o", str(tmp_path))
    assert done.returncode == 0, done.stderr
    files = [str(tmp_path / name) for name in ("raw.tiff", "psf.tiff", "picture.png")]
    done = without_the_extras("reconstruct", files[0], "--psf", files[1], "-o", files[2])
    assert done.returncode == 0, done.stderr


def test_a_command_of_the_instrument_names_the_extra() -> None:
    done = without_the_extras("run")
    assert done.returncode == 2
    assert 'pip install "diffuscope[instrument]"' in done.stderr
    assert "Traceback" not in done.stderr


def test_an_archive_is_planned_without_its_extra_and_run_with_it(tmp_path: Path) -> None:
    scene, plan = tmp_path / "tiny.toml", str(tmp_path / "plan.toml")
    scene.write_text(small_head_toml("Tiny simulated head", summed=4))
    assert without_the_extras("simulate", str(scene), "-o", str(tmp_path / "eye")).returncode == 0
    done = without_the_extras("archive", "plan", str(tmp_path / "eye"), "-o", plan)
    assert done.returncode == 0, done.stderr
    done = without_the_extras("archive", "run", plan, "-o", str(tmp_path / "out"))
    assert done.returncode == 2
    assert 'pip install "diffuscope[archive]"' in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
