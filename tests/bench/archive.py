"""`python -m tests.bench.archive COUNT DATA`: reprocessing on Dask against bare processes, memory, kills, and quality.

Frames of the small simulated head (270 x 480 pixels) at three light levels, every tenth with a defect, as own pairs;
and the recordings in DATA/lensless, if given. The earlier pictures are those of the quick look's method.
"""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import psutil
import tifffile

from device.config.head_file import load_head
from device.sim.render import crop_or_pad
from services.archive import cluster
from services.archive.plan import Plan, read_plan
from services.archive.report import LOSS_DB
from services.archive.result import TABLE, ResultFolder
from services.archive.solve import CalibrationFiles, Solvers, Task, local_names
from tests.simulated import expected_electrons, small_head_toml, world

COMMAND = str(Path(sys.executable).parent / "diffuscope")
ROUNDS = 10
LIGHT = (1.0, 0.2, 0.04)  # of 15,000 electrons in the brightest pixel
EARLIER_METHOD = "gradient"
EVERY = 10  # a hard frame among so many: clipped, half covered, or without signal
REPORT = Path("out/archive-bench.html")
SPAWNED = get_context("spawn")


def write_archive(folder: Path, count: int) -> None:
    """Write `count` frames of one simulated eye with new noise in each, its PSF and its truth."""
    (folder / "head.toml").write_text(small_head_toml("Bench head"))
    seen = world(load_head(folder / "head.toml"))
    colour = seen.spec.light.colour
    expected, rng = np.maximum(expected_electrons(seen), 0), np.random.default_rng(0)
    source = folder / "recording"
    for name in ("raw", "truth"):
        (source / name).mkdir(parents=True)
    tifffile.imwrite(source / "psf.tiff", crop_or_pad(seen.psf(colour), seen.shape))
    np.save(folder / "truth.npy", seen.truth(colour))
    for k in range(count):
        electrons = rng.poisson(expected * LIGHT[k % 3]) + rng.normal(0, 2, expected.shape)
        frame = np.clip(electrons / 4 + 64, 0, 4095)
        if k % EVERY == EVERY - 1:
            frame = hard(frame, k // EVERY % 3, rng)
        tifffile.imwrite(source / "raw" / f"eye{k:05d}.tiff", frame.round().astype(np.uint16))
        (source / "truth" / f"eye{k:05d}.npy").symlink_to(folder / "truth.npy")


def hard(frame: np.ndarray, kind: int, rng: np.random.Generator) -> np.ndarray:
    """Return a frame that is clipped, half covered by a lid, or without any signal."""
    if kind == 0:
        return np.clip(4 * frame, 0, 4095)
    if kind == 1:
        return np.where(np.arange(frame.shape[0])[:, None] < frame.shape[0] // 2, 64, frame)
    return rng.normal(64, 0.5, frame.shape)


def command(*words: object) -> list[str]:
    return [COMMAND, "archive", *map(str, words)]


def solve_bare(plan_file: Path, root: Path, part: int, parts: int) -> None:
    """Compute every `parts`-th capture of a plan in this process, without Dask."""
    os.environ["OMP_NUM_THREADS"] = "1"
    plan, results = read_plan(plan_file), ResultFolder(root)
    calibrations = CalibrationFiles(root / f"calibrations-{part}")
    for calibration in plan.calibrations:
        pairs = zip(local_names(calibration), calibration.files, strict=True)
        calibrations.add(calibration.digest, {name: Path(file.path).read_bytes() for (_, name), file in pairs})
    solvers = Solvers(calibrations)
    for capture in plan.captures[part::parts]:
        task = Task(capture, plan.calibration(capture.calibration), plan.settings, plan.software)
        solvers.solve(task, results, "bare")


def children_s() -> float:
    """Return the processor seconds of all ended child processes, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def bare(plan_file: Path, root: Path, processes: int) -> float:
    """Return the seconds of a plan in bare processes, their start included."""
    begin_s = time.monotonic()
    root.mkdir()
    ResultFolder(root).prepare(read_plan(plan_file))
    below = [SPAWNED.Process(target=solve_bare, args=(plan_file, root, k, processes)) for k in range(processes)]
    for process in below:
        process.start()
    for process in below:
        process.join()
    return time.monotonic() - begin_s


def workers_of(run: psutil.Process) -> list[psutil.Process]:
    """Return the worker processes of a run on one machine."""
    try:
        return [process for process in run.children(recursive=True) if "spawn_main" in " ".join(process.cmdline())]
    except psutil.NoSuchProcess:
        return []


def on_dask(plan_file: Path, root: Path, workers: int) -> tuple[float, list[float]]:
    """Return the seconds of a run, and the memory in MB of its largest worker, once a second."""
    begin_s, memory_mb = time.monotonic(), []
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command("run", plan_file, "-o", root, "--workers", workers), **quiet) as run:  # type: ignore[call-overload]
        while run.poll() is None:
            below = workers_of(psutil.Process(run.pid))
            memory_mb.append(
                max((process.memory_info().rss / 1e6 for process in below if process.is_running()), default=0.0)
            )
            time.sleep(1)
    return time.monotonic() - begin_s, memory_mb


def same_results(plan: Plan, left: Path, right: Path) -> bool:
    """Return whether two folders have the same pictures and reports, byte by byte."""
    first, second = ResultFolder(left), ResultFolder(right)
    return all(
        (first.place(name) / file).read_bytes() == (second.place(name) / file).read_bytes()
        for name in (capture.result for capture in plan.captures)
        if first.has(name) or second.has(name)
        for file in ("picture.tiff", "report.json")
    )


def overhead_s(plan: Plan, root: Path, tasks: int = 2000) -> float:
    """Return the seconds of one task whose result is there already: submission, scheduling, transport."""
    results, first = ResultFolder(root), plan.captures[0]
    captures = tuple(first.model_copy(update={"result": f"{k:032x}"}) for k in range(tasks))
    for capture in captures:
        results.place(capture.result).mkdir(parents=True)
        (results.place(capture.result) / "report.json").touch()
    with cluster.connected(1, None) as client:
        names = [capture.result for capture in captures]
        begin_s = time.monotonic()
        count = sum(1 for _ in cluster.outcomes(client, plan.model_copy(update={"captures": captures}), names, root))
        return (time.monotonic() - begin_s) / count


@contextmanager
def started_run(plan_file: Path, root: Path) -> Iterator["subprocess.Popen[bytes]"]:
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command("run", plan_file, "-o", root, "--workers", 2), **quiet) as run:  # type: ignore[call-overload]
        yield run


def with_kills(plan_file: Path, root: Path, worker_kills: int, run_kills: int) -> tuple[int, int]:
    """Run a plan to its end under random kills of workers and of runs (with the scheduler); return both counts."""
    rng, killed, ended = np.random.default_rng(2), 0, 0
    while True:
        with started_run(plan_file, root) as run:
            share = -(-worker_kills // (run_kills + 1)) * (ended + 1)  # of the workers before this run is killed
            while run.poll() is None:
                time.sleep(float(rng.uniform(1.0, 4.0)))
                below = workers_of(psutil.Process(run.pid)) if run.poll() is None else []
                if killed < min(worker_kills, share) and len(below) == 2 and any(root.glob("results/*")):
                    below[rng.integers(2)].kill()
                    killed += 1
                elif killed >= share and ended < run_kills:
                    run.kill()
                    ended += 1
            if run.returncode in (0, 1) and (root / "captures.parquet").is_file():
                return killed, ended


def planned(sources: list[Path], plan_file: Path, *options: object) -> Plan:
    """Return the plan of some sources, by the command."""
    subprocess.run(command("plan", *sources, "-o", plan_file, *options), check=True, stdout=subprocess.DEVNULL)
    return read_plan(plan_file)


def add_earlier_pictures(source: Path, folder: Path) -> None:
    """Reconstruct the frames of a folder by EARLIER_METHOD, and put the pictures where a plan finds earlier ones."""
    plan = planned([source], folder / "earlier.toml", "--method", EARLIER_METHOD)
    on_dask(folder / "earlier.toml", folder / "earlier", 2)
    results = ResultFolder(folder / "earlier")
    (source / "before").mkdir()
    for capture in plan.captures:
        if results.has(capture.result):
            (source / "before" / f"{Path(capture.raw).stem}.tiff").symlink_to(
                results.place(capture.result) / "picture.tiff"
            )


def judge_quality(root: Path) -> None:
    """Print PSNR and correlation before and after, and every capture that got worse, with its messages."""
    rows = pd.read_parquet(root / TABLE)
    both = rows.dropna(subset=["psnr_db", "before_psnr_db"])
    for name, unit in (("psnr_db", "dB"), ("pcc", "")):
        print(
            f"{name}: {len(both)} captures, mean {both[f'before_{name}'].mean():.3f} -> {both[name].mean():.3f} {unit}"
        )
    worse = both[both["psnr_db"] - both["before_psnr_db"] < LOSS_DB]
    print(f"worse by more than {-LOSS_DB} dB: {len(worse)}")
    for _, row in worse.iterrows():
        loss_db = row["before_psnr_db"] - row["psnr_db"]
        print(
            f"  {row['id']}: -{loss_db:.2f} dB of {row['before_psnr_db']:.1f}, {row['method']}; {list(row['messages'])}"
        )


def main() -> None:
    """Print all figures."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    recordings = sorted((Path(sys.argv[2]) / "lensless").iterdir()) if len(sys.argv) > 2 else []
    with TemporaryDirectory(prefix="archive-") as place:
        folder = Path(place)
        write_archive(folder, count)
        add_earlier_pictures(folder / "recording", folder)
        plan_file, seconds = folder / "plan.toml", {}
        plan = planned([folder / "recording", *recordings], plan_file, "--rounds", ROUNDS)
        count = len(plan.captures)
        print(f"{count} captures, {len(plan.left_out)} left out, {len(plan.calibrations)} calibrations", flush=True)
        for processes in (1, 2):
            used_s = [children_s()]
            seconds[f"bare {processes}"] = bare(plan_file, folder / f"bare{processes}", processes)
            used_s.append(children_s())
            seconds[f"dask {processes}"], memory_mb = on_dask(plan_file, folder / f"dask{processes}", processes)
            used_s.append(children_s())
            bare_s, dask_s = used_s[1] - used_s[0], used_s[2] - used_s[1]
            print(f"{processes}: processor time {bare_s:.0f} s bare, {dask_s:.0f} s Dask: {bare_s / dask_s:.3f}")
            half = len(memory_mb) // 2
            late = max(memory_mb[half:]) - max(memory_mb[half // 2 : half], default=0.0)
            print(f"{processes}: largest worker {max(memory_mb):.0f} MB, second half {late:+.0f} MB", flush=True)
            for kind in ("bare", "dask"):
                print(f"{kind} {processes}: {count / seconds[f'{kind} {processes}'] * 60:.0f} captures a minute")
            print(f"efficiency: {seconds[f'bare {processes}'] / seconds[f'dask {processes}']:.3f}", flush=True)
        print(f"overhead of a task: {1e3 * overhead_s(plan, folder / 'empty'):.2f} ms", flush=True)
        killed = with_kills(plan_file, folder / "killed", min(30, count // 4), 3)
        rows = pd.read_parquet(folder / "killed" / "captures.parquet")
        print(f"kills of workers and runs: {killed}; rows {len(rows)}, states {dict(rows['state'].value_counts())}")
        for other in ("bare1", "bare2", "dask1", "dask2"):
            print(f"same bytes as {other}: {same_results(plan, folder / 'killed', folder / other)}")
        judge_quality(folder / "killed")
        subprocess.run(command("report", folder / "killed", "-o", REPORT), check=True)
        print(json.dumps(seconds))


if __name__ == "__main__":
    main()
