"""How often a good calibration is doubted, and which misfits are noticed, beside what each costs the picture."""

from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import product

import numpy as np

from device.calibration.check import HOT_FROM, LEAST_SCORE, OFF_DEG, SURE_SD, WIDER, Exposures, check, look
from device.clock import SystemClock, VirtualClock
from device.recon.metrics import Judge
from device.recon.model import field_radius_px
from device.recon.plan import Planner
from device.recon.reconstructor import Recipe, Reconstructor
from device.recon.refraction import Refractor
from device.recon.witness import Statement, Witness
from device.sim.calibrate import simulated_calibration
from device.sim.world import World
from device.spec import load_head
from device.values import Counts
from tests import misfits
from tests.misfits import calibrated, dark, lit, point
from tests.simulated import exposed

NOW = datetime(2026, 1, 1, tzinfo=UTC)
RETINAS, SPHERES_DPT = range(1, 11), (-8.0, -4.0, 0.0, 2.0, 8.0)
LIGHTS = (1.0, 0.2, 0.03, 0.01)  # a peak of 15000, 3000, 450 and 150 electrons in 5 um pixels

MOVED_PX = 12  # a picture that is as good at another place is not a worse one


@dataclass(frozen=True)
class Row:
    """A misfit and the frame it makes."""

    name: str
    frame: Counts


def fitness(planner: Planner) -> None:
    """Print the spread of what is measured on a good head, then one line for each misfit."""
    shape = misfits.world().shape
    make = Reconstructor(calibrated(), shape, planner, VirtualClock(), (Recipe("gradient", 1),))
    assert make.refractor is not None
    witness, clock = Witness(make.refractor), SystemClock()
    told, seconds = [], []
    for number, (retina, m_dpt, light) in enumerate(product(RETINAS, SPHERES_DPT, LIGHTS)):
        frame = lit(point(m_dpt), retina, light, number)
        begin_s = clock.now_s()
        told.append((_sure(witness(frame, dark(noise=number))), light))
        seconds.append(clock.now_s() - begin_s)
    for light in LIGHTS:
        print(f"\n{light:.0%} of the light:")
        _spread([one for one, by in told if one is not None and by == light], len(told) // len(LIGHTS))
    print(f"one capture takes {np.median(seconds):.2f} s of idle time at {shape[0]} x {shape[1]}")
    _misfits(make, witness)
    _darks()
    _waits(planner)


def _sure(one: Statement | None) -> Statement | None:
    return one if one is not None and one.sd <= SURE_SD else None


def _spread(told: list[Statement], asked: int) -> None:
    score = np.array([one.most for one in told])
    off = np.array([np.hypot(*one.off_deg) for one in told])
    wider = np.abs([one.wider for one in told])
    print(f"a good head: {asked} frames, {len(told)} of them say something about the PSF")
    for name, seen, limit, alarms in (
        ("psf", score, LEAST_SCORE, score < LEAST_SCORE),
        ("shift, deg", off, OFF_DEG, off > OFF_DEG),
        ("width", wider, WIDER, wider > WIDER),
    ):
        low, middle, high = np.percentile(seen, (0, 50, 100))
        print(f"  {name:<12} {low:6.3f} .. {middle:6.3f} .. {high:6.3f}   limit {limit:g}, beyond: {alarms.sum()}")


def _misfits(make: Reconstructor, witness: Witness) -> None:
    inside = misfits.world().truth("green") > 0
    radius_px = field_radius_px(make.calibration)
    rows, cols = (np.arange(size) - size // 2 for size in make.shape)
    inside &= np.hypot(rows[:, None], cols) < 0.95 * radius_px
    judge = Judge(misfits.world().truth("green"), inside, 8.0)
    print(f"\n{'misfit':<26} {'psf':>6} {'shift':>6} {'width':>7} {'PSNR, dB':>9}")
    for row in _rows():
        one, made = witness(row.frame, dark()), make(row.frame, dark())
        assert one is not None
        psnr_db = max(judge(np.roll(made.picture, by, 1)).psnr_db for by in range(-MOVED_PX, MOVED_PX + 1))
        print(f"{row.name:<26} {one.most:6.2f} {np.hypot(*one.off_deg):6.2f} {one.wider:+7.2%} {psnr_db:9.2f}")


def _rows() -> list[Row]:
    rows = [Row("none", lit(point()))]
    rows += [Row(f"turned by {deg:g} deg", lit(point(turned_deg=deg))) for deg in (0.25, 0.5, 0.75, 1.0, 2.0)]
    rows += [Row(f"shifted by {um:g} um", lit(misfits.slid(um))) for um in (20.0, 50.0, 100.0, 200.0)]
    rows += [Row(f"axially by {um:+g} um", misfits.farther(um)) for um in (-300.0, -100.0, 50.0, 100.0, 300.0)]
    rows += [Row(f"all moved by {deg:.2g} deg", misfits.aside(deg)) for deg in (0.25, 0.5, 1.0, 2.0)]
    return rows + [Row(f"another diffuser ({seed})", lit(point(diffuser=seed))) for seed in (5, 6, 7)]


def _darks() -> None:
    for black_dn, hot in product((0.0, 1.0, 3.0), (0.0, HOT_FROM, 5e-4, 2e-3)):
        seen = [
            look(calibrated(), None, None, Exposures(NOW, np.empty((0, 0), np.uint16), dark(black_dn, hot, n), 0.1))
            for n in range(3)
        ]
        found = ", ".join(
            f"{one.name} {one.value:.3g} {one.unit} {'ok' if one.ok else 'FAILS' if one.fails else 'hint'}"
            for one in check(calibrated(), None, seen, (), NOW)
        )
        print(f"black {black_dn:+g} DN, {hot:.2%} of the pixels hot: {found}")


def _waits(planner: Planner) -> None:
    """How long a press may have to wait for a look that is under way, at the sensor's full size."""
    spec, clock = load_head(misfits.HEAD), SystemClock()
    world = World(spec, VirtualClock())
    calibration = simulated_calibration(world)
    witness = Witness(Refractor(calibration, world.shape, planner, 0))
    at = Exposures(NOW, exposed(world), exposed(world, lit=False), spec.camera.exposure_s)
    looks = []
    for _ in range(5):
        moments_s = [clock.now_s()]
        look(calibration, None, witness, at, lambda into=moments_s: into.append(clock.now_s()))
        looks.append(np.diff([*moments_s, clock.now_s()]))
    whole_s, longest_s, usual_s = (np.median([of(one) for one in looks]) for of in (np.sum, np.max, np.median))
    waits = f"a press waits {1e3 * usual_s:.1f} ms, {1e3 * longest_s:.0f} at most"
    print(f"a capture of {world.shape}: {whole_s:.2f} s; {waits}")
