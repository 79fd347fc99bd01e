"""Bill of materials of an image: its Python packages are those of the lock file, or it is not made."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.project_files import ROOT, text

LOCK = "systemd/image/requirements.lock"
VERSIONS = {
    line.split("==")[0]: line.split("==")[1].split()[0]
    for line in text(LOCK).splitlines()
    if "==" in line and not line.startswith(" ") and "python_full_version <" not in line
}


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Packages of the root file system `tmp_path`: those that the lock file names."""
    status = tmp_path / "var/lib/dpkg/status"
    status.parent.mkdir(parents=True)
    status.write_text("Package: base-files\nStatus: install ok installed\nVersion: 13\nArchitecture: arm64")
    site = tmp_path / "opt/diffuscope/.venv/lib/python3.13/site-packages"
    for name, version in VERSIONS.items():
        write_package(site, name, version)
    return site


def write_package(site: Path, name: str, version: str) -> None:
    folder = site / f"{name}.dist-info"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\n")


def bill(root: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "systemd/image/sbom.py", str(root), "1.0", "0" * 12]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_the_bill_has_each_locked_package(tmp_path: Path, site: Path) -> None:
    made = json.loads(bill(tmp_path).stdout)
    assert {part["name"] for part in made["components"]} == {"base-files", *VERSIONS}


def test_a_package_that_is_not_locked_makes_no_bill(tmp_path: Path, site: Path) -> None:
    write_package(site, "fastapi", "0.1")
    write_package(site, "leftpad", "1.0")
    (site / "pydantic.dist-info/METADATA").unlink()
    done = bill(tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines() == ["fastapi 0.1 is not locked", "leftpad 1.0 is not locked", "pydantic is missing"]
