"""False alarms and detected faults of the calibration monitor, with the effect of each fault on the picture."""

from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import product

import numpy as np

from device.calibration.monitoring.head_check import (
    HOT_HINT_SHARE,
    MAX_SCORE_SD,
    MAX_SHIFT_DEG,
    MAX_WIDTH_CHANGE,
    MIN_SCORE,
    ExposurePair,
    assess_capture,
    check,
)
from device.clock import SystemClock, VirtualClock
from device.config.head_file import load_head
from device.recon.assessment.metrics import PictureScorer
from device.recon.assessment.psf_match_any_refraction import PsfMatchResult, PsfMatchTest
from device.recon.estimation.refraction.estimator import RefractionEstimator
from device.recon.model.fft_plans import Planner
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.recon.stage import Recipe
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Counts
from tests import changed_heads
from tests.changed_heads import calibrated, caustic_of_eye, dark, frame_through
from tests.simulated import exposed_counts

NOW = datetime(2026, 1, 1, tzinfo=UTC)
RETINAS, SPHERES_DPT = range(1, 11), (-8.0, -4.0, 0.0, 2.0, 8.0)
LIGHTS = (1.0, 0.2, 0.03, 0.01)  # peaks of 15000, 3000, 450 and 150 electrons in 5 um pixels

MOVED_PX = 12  # a shifted picture is not judged as worse, up to this shift


@dataclass(frozen=True)
class Row:
    """A fault and a frame with that fault."""

    name: str
    frame: Counts


def fitness(planner: Planner) -> None:
    """Print the spread of the measures on an unchanged head, then one line per fault."""
    shape = changed_heads.world().shape
    make = Reconstructor(calibrated(), shape, planner, VirtualClock(), (Recipe("gradient", 1),))
    assert make.refractor is not None
    psf_check, clock = PsfMatchTest(make.refractor), SystemClock()
    statements, seconds = [], []
    for number, (retina, m_dpt, light) in enumerate(product(RETINAS, SPHERES_DPT, LIGHTS)):
        frame = frame_through(caustic_of_eye(m_dpt), retina, light, number)
        begin_s = clock.now_s()
        statements.append((_sure(psf_check(frame, dark(noise=number))), light))
        seconds.append(clock.now_s() - begin_s)
    for light in LIGHTS:
        print(f"\n{light:.0%} of the light:")
        _spread(
            [statement for statement, by in statements if statement is not None and by == light],
            len(statements) // len(LIGHTS),
        )
    print(f"one capture takes {np.median(seconds):.2f} s of idle time at {shape[0]} x {shape[1]}")
    _changed_heads(make, psf_check)
    _darks()
    _waits(planner)


def _sure(statement: PsfMatchResult | None) -> PsfMatchResult | None:
    return statement if statement is not None and statement.sd <= MAX_SCORE_SD else None


def _spread(statements: list[PsfMatchResult], asked: int) -> None:
    score = np.array([statement.upper_limit for statement in statements])
    off = np.array([np.hypot(*statement.field_offset_deg) for statement in statements])
    wider = np.abs([statement.field_radius_change_ratio for statement in statements])
    print(f"a good head: {asked} frames, {len(statements)} of them say something about the PSF")
    for name, seen, limit, alarms in (
        ("psf", score, MIN_SCORE, score < MIN_SCORE),
        ("shift, deg", off, MAX_SHIFT_DEG, off > MAX_SHIFT_DEG),
        ("width", wider, MAX_WIDTH_CHANGE, wider > MAX_WIDTH_CHANGE),
    ):
        low, middle, high = np.percentile(seen, (0, 50, 100))
        print(f"  {name:<12} {low:6.3f} .. {middle:6.3f} .. {high:6.3f}   limit {limit:g}, beyond: {alarms.sum()}")


def _changed_heads(make: Reconstructor, psf_check: PsfMatchTest) -> None:
    inside = changed_heads.world().truth("green") > 0
    radius_px = field_radius_px(make.calibration)
    rows, cols = (np.arange(size) - size // 2 for size in make.shape)
    inside &= np.hypot(rows[:, None], cols) < 0.95 * radius_px
    judge = PictureScorer(changed_heads.world().truth("green"), inside, 8.0)
    print(f"\n{'misfit':<26} {'psf':>6} {'shift':>6} {'width':>7} {'PSNR, dB':>9}")
    for row in _rows():
        statement, made = psf_check(row.frame, dark()), make(row.frame, dark())
        assert statement is not None
        psnr_db = max(judge(np.roll(made.picture, by, 1)).psnr_db for by in range(-MOVED_PX, MOVED_PX + 1))
        print(
            f"{row.name:<26} {statement.upper_limit:6.2f} {np.hypot(*statement.field_offset_deg):6.2f} "
            f"{statement.field_radius_change_ratio:+7.2%} {psnr_db:9.2f}"
        )


def _rows() -> list[Row]:
    rows = [Row("none", frame_through(caustic_of_eye()))]
    rows += [
        Row(f"turned by {deg:g} deg", frame_through(caustic_of_eye(turned_deg=deg)))
        for deg in (0.25, 0.5, 0.75, 1.0, 2.0)
    ]
    rows += [
        Row(f"shifted by {um:g} um", frame_through(changed_heads.caustic_of_shifted_diffuser(um)))
        for um in (20.0, 50.0, 100.0, 200.0)
    ]
    rows += [
        Row(f"axially by {um:+g} um", changed_heads.frame_at_larger_distance(um))
        for um in (-300.0, -100.0, 50.0, 100.0, 300.0)
    ]
    rows += [
        Row(f"all moved by {deg:.2g} deg", changed_heads.frame_of_shifted_sensor(deg)) for deg in (0.25, 0.5, 1.0, 2.0)
    ]
    return rows + [
        Row(f"another diffuser ({seed})", frame_through(caustic_of_eye(diffuser=seed))) for seed in (5, 6, 7)
    ]


def _darks() -> None:
    for black_dn, hot in product((0.0, 1.0, 3.0), (0.0, HOT_HINT_SHARE, 5e-4, 2e-3)):
        seen = [
            assess_capture(
                calibrated(), None, None, ExposurePair(NOW, np.empty((0, 0), np.uint16), dark(black_dn, hot, n), 0.1)
            )
            for n in range(3)
        ]
        found = ", ".join(
            f"{finding.name} {finding.value:.3g} {finding.unit} "
            f"{'ok' if finding.ok else 'FAILS' if finding.fails else 'hint'}"
            for finding in check(calibrated(), None, seen, (), NOW)
        )
        print(f"black {black_dn:+g} DN, {hot:.2%} of the pixels hot: {found}")


def _waits(planner: Planner) -> None:
    """Print the longest delay of a press by a running check, at full sensor size."""
    spec, clock = load_head(changed_heads.HEAD), SystemClock()
    world = World(spec, VirtualClock())
    calibration = simulated_calibration(world)
    witness = PsfMatchTest(RefractionEstimator(calibration, world.shape, planner, 0))
    at = ExposurePair(NOW, exposed_counts(world), exposed_counts(world, lit=False), spec.camera.exposure_s)
    looks = []
    for _ in range(5):
        moments_s = [clock.now_s()]
        assess_capture(calibration, None, witness, at, lambda into=moments_s: into.append(clock.now_s()))
        looks.append(np.diff([*moments_s, clock.now_s()]))
    whole_s, longest_s, usual_s = (np.median([of(look) for look in looks]) for of in (np.sum, np.max, np.median))
    waits = f"a press waits {1e3 * usual_s:.1f} ms, {1e3 * longest_s:.0f} at most"
    print(f"a capture of {world.shape}: {whole_s:.2f} s; {waits}")
