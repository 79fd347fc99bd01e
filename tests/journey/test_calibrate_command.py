"""`diffuscope calibrate` as a process that is killed between its steps and resumes."""

import signal
import subprocess
from pathlib import Path

import pytest

from device.calibration.archive import Archive
from device.errors import CalibrationMissing
from tests.journey.conftest import COMMAND, Diffuscope
from tests.project_files import ROOT


def test_killed_calibration_resumes(
    diffuscope: Diffuscope, environment: dict[str, str], head_file: Path, tmp_path: Path
) -> None:
    quick = tmp_path / "head.toml"  # a tenth of the exposure, because this test runs in real time
    quick.write_text(
        head_file.read_text().replace("[camera]", "[camera]\nexposure_s = 0.01\npreview_exposure_s = 0.01")
    )
    archive = Archive(tmp_path / "archive")
    words = ("calibrate", "--head", str(quick), "--archive", str(archive.root), "--by", "a technician")
    with subprocess.Popen([COMMAND, *words], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as killed:
        assert killed.stdout is not None
        assert killed.stdout.readline() == "darks: done\n"
        killed.send_signal(signal.SIGKILL)
    with pytest.raises(CalibrationMissing):
        archive.active_id()
    done = diffuscope(*words)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("darks: measured before, taken up again\nflats: done\n")
    kept = archive.load()
    assert kept.provenance.made_by == "a technician"
    assert f"{kept.calibration.id} is in force" in done.stdout
