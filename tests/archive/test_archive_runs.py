"""Runs of `diffuscope archive` in real processes: results, table, resumption, faults of sources and of clusters."""

import json
import signal
import subprocess
import time
from collections.abc import Iterable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import psutil
import pytest
import tifffile

from device import atomic_io
from device.calibration.archive import Archive as Calibrations
from device.calibration.archive import Provenance
from device.clock import VirtualClock
from device.values import Sensor
from services.archive.plan import InputFile, PlannedCalibration, read_plan
from services.archive.result import ResultFolder
from services.archive.solve import CalibrationFiles, Solvers, Task, local_names
from tests.archive.conftest import COMMAND, FRAMES, Archive, result_digests, write_recording
from tests.datasets import Scene
from tests.scenes import calibration
from tests.stored_captures import write_store


@pytest.fixture(scope="module")
def whole(scene: Scene, archive: Archive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A plan, and the folder of its uninterrupted run with one worker."""
    folder = tmp_path_factory.mktemp("whole")
    write_recording(folder / "recording", scene)
    assert archive("plan", folder / "recording", "-o", folder / "plan.toml", "--rounds", 3).returncode == 0
    done = archive("run", folder / "plan.toml", "-o", folder / "out", "--workers", 1)
    assert done.returncode == 0, done.stderr
    return folder / "plan.toml", folder / "out"


def test_every_capture_has_one_result_and_one_row(whole: tuple[Path, Path]) -> None:
    plan, out = whole
    names = [capture.result for capture in read_plan(plan).captures]
    assert sorted(path.name for path in out.glob("results/*/*")) == sorted(names)
    rows = pd.read_parquet(out / "captures.parquet")
    assert list(rows["result"]) == names
    assert set(rows["state"]) == {"done"}
    assert (rows["rounds"] == 3).all()
    assert rows["psnr_db"].notna().all()
    picture = tifffile.imread(out / rows["picture"][0])
    assert picture.dtype == np.float32


def test_duckdb_reads_the_table(whole: tuple[Path, Path]) -> None:
    query = f"select state, count(*), max(total_s) from '{whole[1] / 'captures.parquet'}' group by state"
    ((state, count, seconds),) = duckdb.sql(query).fetchall()
    assert (state, count) == ("done", FRAMES)
    assert seconds > 0


def test_a_second_run_computes_nothing(whole: tuple[Path, Path], archive: Archive) -> None:
    before = result_digests(whole[1])
    done = archive("run", whole[0], "-o", whole[1])
    assert "0 computed" in done.stdout
    assert result_digests(whole[1]) == before


def test_two_workers_give_the_same_bytes(whole: tuple[Path, Path], archive: Archive, tmp_path: Path) -> None:
    done = archive("run", whole[0], "-o", tmp_path / "out", "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert result_digests(tmp_path / "out") == result_digests(whole[1])


def wait_for_results(out: Path, least: int) -> None:
    end = time.monotonic() + 60
    while len(list(out.glob("results/*/*/report.json"))) < least:
        assert time.monotonic() < end, "no results"
        time.sleep(0.02)


def kill_a_worker(run: psutil.Process, rng: np.random.Generator) -> bool:
    """Kill one worker process of a run, if there is one; nannies start it again."""
    below = [process for process in run.children(recursive=True) if "spawn_main" in " ".join(process.cmdline())]
    if not below:
        return False
    below[rng.integers(len(below))].kill()
    return True


def test_a_killed_worker_and_a_killed_run_leave_the_same_bytes(
    whole: tuple[Path, Path], environment: dict[str, str], archive: Archive, tmp_path: Path
) -> None:
    """The scheduler of a run on one machine is in the process of the run."""
    out, rng = tmp_path / "out", np.random.default_rng(1)
    command = [COMMAND, "archive", "run", str(whole[0]), "-o", str(out), "--workers", "2"]
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as run:
        wait_for_results(out, 3)
        assert kill_a_worker(psutil.Process(run.pid), rng)
        wait_for_results(out, 6)
        run.send_signal(signal.SIGKILL)
    done = archive("run", whole[0], "-o", out, "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert result_digests(out) == result_digests(whole[1])
    assert list(pd.read_parquet(out / "captures.parquet")["state"]) == ["done"] * FRAMES


@pytest.fixture
def scheduler(environment: dict[str, str], tmp_path: Path) -> Iterator[tuple[str, "subprocess.Popen[bytes]"]]:
    """Address and process of a Dask scheduler with one worker in another folder, as on a cluster."""
    python, file = str(Path(COMMAND).parent / "dask"), tmp_path / "scheduler.json"
    words = [python, "scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", ":0", "--scheduler-file"]
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    with subprocess.Popen([*words, str(file)], **quiet) as process:
        end = time.monotonic() + 30
        while not file.is_file():
            assert time.monotonic() < end
            time.sleep(0.1)
        worker = [python, "worker", "--scheduler-file", str(file), "--nthreads", "1", "--dashboard-address", ":0"]
        (tmp_path / "worker").mkdir()
        with subprocess.Popen(worker, cwd=tmp_path / "worker", **quiet) as other:
            yield json.loads(file.read_text())["address"], process
            other.terminate()
        process.terminate()


def test_a_lost_scheduler_ends_the_run_with_a_message_and_another_run_resumes(
    whole: tuple[Path, Path],
    scheduler: tuple[str, "subprocess.Popen[bytes]"],
    environment: dict[str, str],
    archive: Archive,
    tmp_path: Path,
) -> None:
    out, (address, process) = tmp_path / "out", scheduler
    command = [COMMAND, "archive", "run", str(whole[0]), "-o", out.name, "--scheduler", address]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as run:
        wait_for_results(out, 3)
        process.kill()
        error = run.communicate(timeout=60)[1]
    assert run.returncode == 2, error
    assert "it resumes" in error.splitlines()[-1]  # Dask may log its own lines before
    assert archive("run", whole[0], "-o", out, "--workers", 2).returncode == 0
    assert result_digests(out) == result_digests(whole[1])


def test_bad_input_is_put_into_quarantine_with_its_reason(
    recording: Path, plan: Path, archive: Archive, tmp_path: Path, scene: Scene
) -> None:
    raws = recording / "raw"
    (raws / "eye001.tiff").write_bytes((raws / "eye001.tiff").read_bytes()[:3000])
    (raws / "eye002.tiff").unlink()
    tifffile.imwrite(raws / "small.tiff", scene.raw[::2, ::2])
    (raws / "text.png").write_text("no picture")
    assert archive("plan", recording, "-o", tmp_path / "other.toml", "--rounds", 3).returncode == 0
    tifffile.imwrite(raws / "eye003.tiff", scene.raw + 1)
    done = archive("run", tmp_path / "other.toml", "-o", tmp_path / "out", "--workers", 1)
    assert done.returncode == 1, done.stderr
    rows = pd.read_parquet(tmp_path / "out" / "captures.parquet").set_index("id")
    reasons = rows.loc[rows["state"] == "quarantine", "reason"]
    assert sorted(reasons.index) == ["eye001", "eye003", "small", "text"]
    assert "another content" in reasons["eye003"]
    assert "30 x 40" in reasons["small"]
    assert "not a whole" in reasons["text"]
    assert str(tmp_path / "out" / "quarantine") in done.stdout
    tifffile.imwrite(raws / "eye001.tiff", scene.raw + 2)
    assert archive("plan", recording, "-o", tmp_path / "mended.toml", "--rounds", 3).returncode == 0
    done = archive("run", tmp_path / "mended.toml", "-o", tmp_path / "out", "--workers", 1)
    assert "2 in quarantine" in done.stdout, done.stderr
    assert "2 computed" in done.stdout  # the frames that were replaced; the others have a result, or cannot succeed
    assert len(list((tmp_path / "out" / "earlier-plans").iterdir())) == 1
    (raws / "eye004.tiff").unlink()
    done = archive("run", plan, "-o", tmp_path / "gone", "--workers", 1)
    lost = pd.read_parquet(tmp_path / "gone" / "captures.parquet").set_index("id")
    assert "No such file" in lost.loc["eye004", "reason"]


def test_a_source_that_is_gone_ends_the_run(recording: Path, plan: Path, archive: Archive, tmp_path: Path) -> None:
    recording.joinpath("psf.tiff").rename(tmp_path / "psf.tiff")
    done = archive("run", plan, "-o", tmp_path / "out", "--workers", 1)
    assert done.returncode == 2
    assert "psf.tiff cannot be read" in done.stderr
    assert "Traceback" not in done.stderr


def test_two_runs_into_one_folder_are_refused(whole: tuple[Path, Path], archive: Archive) -> None:
    with atomic_io.file_lock(whole[1] / ".lock"):
        done = archive("run", whole[0], "-o", whole[1])
    assert done.returncode == 2
    assert "another run is writing" in done.stderr


def test_a_plan_of_other_versions_is_refused(whole: tuple[Path, Path], archive: Archive, tmp_path: Path) -> None:
    code = read_plan(whole[0]).software["code"]
    (tmp_path / "old.toml").write_text(whole[0].read_text().replace(code, "0" * 12))
    done = archive("run", tmp_path / "old.toml", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert f"code {'0' * 12} expected, {code} found" in done.stderr


def test_a_worker_that_outlives_a_plan_takes_the_settings_of_the_next_one(
    recording: Path, archive: Archive, tmp_path: Path
) -> None:
    rounds, solvers = [], None
    for wanted in (3, 1):
        path = tmp_path / f"plan-{wanted}.toml"
        assert archive("plan", recording, "-o", path, "--rounds", wanted).returncode == 0
        plan, results = read_plan(path), ResultFolder(tmp_path / f"out-{wanted}")
        results.prepare(plan)
        (calibration,), first = plan.calibrations, plan.captures[0]
        if solvers is None:
            files = {name: Path(file.path).read_bytes() for (_, name), file in named_files(calibration)}
            calibrations = CalibrationFiles(tmp_path / "calibrations")
            calibrations.add(calibration.digest, files)
            solvers = Solvers(calibrations)
        solvers.solve(Task(first, calibration, plan.settings, plan.software), results, "worker")
        report = results.read(first.result).report["report"]
        assert isinstance(report, dict)
        rounds.append(report["rounds"])
    assert rounds == [3, 1]


def named_files(calibration: PlannedCalibration) -> Iterable[tuple[tuple[str, str], InputFile]]:
    return zip(local_names(calibration), calibration.files, strict=True)


def test_an_archive_of_none_gives_an_empty_table(archive: Archive, tmp_path: Path) -> None:
    (tmp_path / "store" / "captures").mkdir(parents=True)
    assert archive("plan", tmp_path / "store", "-o", tmp_path / "plan.toml").returncode == 0
    done = archive("run", tmp_path / "plan.toml", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert len(pd.read_parquet(tmp_path / "out" / "captures.parquet")) == 0


def test_the_report_shows_improvements_and_losses(recording: Path, archive: Archive, tmp_path: Path) -> None:
    (recording / "before").mkdir()
    for k in range(4):
        truth = np.load(recording / "truth" / f"eye{k:03d}.npy").astype(np.float32)
        before = truth + (1e-3 if k == 0 else 3) * np.random.default_rng(k).normal(size=truth.shape) * truth.std()
        np.save(recording / "before" / f"eye{k:03d}.npy", np.maximum(before, 0).astype(np.float32))
    assert archive("plan", recording, "-o", tmp_path / "plan.toml").returncode == 0
    assert archive("run", tmp_path / "plan.toml", "-o", tmp_path / "out", "--workers", 2).returncode == 0
    done = archive("report", tmp_path / "out", "-o", tmp_path / "report.html")
    assert "4 compared with an earlier picture, 1 got worse" in done.stdout, done.stderr
    page = (tmp_path / "report.html").read_text()
    assert "1 captures got worse" in page
    assert page.count("data:image/jpeg") == 8
    assert "http" not in page.replace("http://www.w3.org", "")
    assert archive("report", tmp_path, "-o", tmp_path / "none.html").returncode == 2


def test_a_store_is_computed_with_its_calibration_and_dark_frames(
    scene: Scene, archive: Archive, tmp_path: Path
) -> None:
    store, made_at = tmp_path / "store", VirtualClock().wall() - timedelta(days=30)
    kept = calibration(scene.psf, sensor=Sensor(black_dn=4.0, white_dn=4095.0))
    id = Calibrations(store / "calibrations" / "tiny").add_and_activate(kept, Provenance("D1", made_at, "test", "0"))
    write_store(store, scene.raw, id, ("a", "b"))
    assert archive("plan", store, "-o", tmp_path / "plan.toml", "--rounds", 2).returncode == 0
    done = archive("run", tmp_path / "plan.toml", "-o", tmp_path / "out", "--workers", 1)
    assert done.returncode == 0, done.stderr
    rows = pd.read_parquet(tmp_path / "out" / "captures.parquet")
    assert list(rows["eye"]) == ["OD", "OD"]
    assert list(rows["device"]) == ["tiny", "tiny"]
    assert list(rows["calibration_age_days"]) == [30, 30]
    assert list(rows["exposure_s"]) == [0.1, 0.1]
    assert rows["simulated"].all()
