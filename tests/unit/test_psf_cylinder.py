"""PSF of the picture for an eye with a cylinder: when it is used, what it gains, and what the report states."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from device.clock import Deadline, SystemClock, VirtualClock
from device.recon.colour_reconstructor import psf_wavefront
from device.recon.estimation.power_law_prior import PowerLaw, band
from device.recon.estimation.psf_gain import PsfGain
from device.recon.estimation.psf_warp import Wavefront, transform, warped
from device.recon.estimation.refraction.burst import FrameScatter
from device.recon.estimation.refraction.estimator import Cylinder, NoRefraction, Refraction
from device.recon.estimation.refraction.field import FieldEdge
from device.recon.frame_run import EyePsf
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import Model, otf
from device.recon.model.grid import Grid
from device.recon.reconstructor import Reconstructor
from device.recon.solvers.solver import Solver
from device.recon.stage import RESERVED_ROUNDS
from device.values import Counts, Geometry, Reconstruction
from tests import moving_retina
from tests.unit.test_burst import psnr_db

GEOMETRY = Geometry(2.4, 8000, 2.0)  # 0.032 per dpt: 2 dpt move the edge of this small PSF by as much as on a sensor
CALIBRATION = replace(
    moving_retina.burst_calibration(), geometry=GEOMETRY, field_deg=moving_retina.FIELD_PX / GEOMETRY.px_per_deg
)
EYE = Wavefront(3.0, 1.2, -1.6)
ROUNDS = 6


@dataclass
class KnownRefraction:
    """Task of a frame whose refraction is known: without a cylinder at once, and whole if it is done."""

    whole_refraction: Refraction | NoRefraction
    is_done: bool = True
    has_found: bool = True
    cylinder_s: float = 0.0
    join_s: float = 0.0
    others: list[Counts] = field(default_factory=list)

    def join(self, others: list[Counts]) -> None:
        self.others = others

    def has_found_by(self, until: Deadline | None) -> bool:
        return until is None or self.has_found

    def is_done_by(self, until: Deadline | None) -> bool:
        self.is_done |= until is None
        return self.is_done

    def found(self) -> Refraction | NoRefraction:
        return refraction(None)

    def latest(self) -> Refraction | NoRefraction:
        return self.whole() if self.is_done else self.found()

    def best(self) -> Refraction | NoRefraction:
        known = self.latest()
        return known if isinstance(known, Refraction) else self.found()

    def whole(self) -> Refraction | NoRefraction:
        return self.whole_refraction


def refraction(cylinder: Cylinder | None) -> Refraction:
    return Refraction(EYE.m_dpt, 0.05, 1.0, 500.0, (), FieldEdge(33.4, 0.1, 0.0, 0.0, 0.0), 0.0, cylinder)


def cylinder(j0_dpt: float = EYE.j0_dpt, j45_dpt: float = EYE.j45_dpt, sd_dpt: float = 0.05) -> Cylinder:
    return Cylinder(j0_dpt, sd_dpt, j45_dpt, sd_dpt)


@pytest.fixture(scope="module")
def reconstruct() -> Reconstructor:
    planner = Planner(folder=None, effort="FFTW_ESTIMATE")
    return Reconstructor(CALIBRATION, moving_retina.SHAPE, planner, SystemClock(), timed=False)


@pytest.fixture(scope="module")
def counts() -> Counts:
    psf = warped(moving_retina.PSF, transform(GEOMETRY, *EYE))
    return moving_retina.frame(moving_retina.seen(moving_retina.RETINA, (0.0, 0.0)), 8000, 1, psf)


def picture(
    reconstruct: Reconstructor, counts: Counts, task: KnownRefraction, deadline: Deadline | None = None
) -> Reconstruction:
    *_, made = reconstruct.steps(
        counts,
        simulated=True,
        deadline=deadline,
        rounds=ROUNDS,
        refraction=task,  # type: ignore[arg-type]  # a stand-in, whose results need no thread
    )
    assert isinstance(made, Reconstruction)
    return made


def quality_db(made: Reconstruction) -> float:
    return psnr_db(made.picture, moving_retina.seen(moving_retina.RETINA, (0.0, 0.0)))


def test_the_psf_with_the_cylinder_gains_and_the_report_states_it(reconstruct: Reconstructor, counts: Counts) -> None:
    """The prediction is that of a linear solution, which is less than what total variation gains (NUMERICS.md 7.8)."""
    sphere = picture(reconstruct, counts, KnownRefraction(refraction(None)))
    made = picture(reconstruct, counts, KnownRefraction(refraction(cylinder())))
    assert sphere.report.psf_cylinder is None
    stated = made.report.psf_cylinder
    assert stated is not None
    assert (stated["j0_dpt"], stated["j45_dpt"]) == (-EYE.j0_dpt, EYE.j45_dpt)  # of the correcting lens, y upwards
    gain_db = quality_db(made) - quality_db(sphere)
    assert gain_db > 0.3
    assert stated["gain_db"] is not None
    assert 0.1 < stated["gain_db"] < gain_db
    assert psf_wavefront(made.report, GEOMETRY) == pytest.approx(EYE)


def test_predicted_gain_is_that_of_wiener_filters_on_drawn_objects() -> None:
    """5 %: 40 draws of 96 x 96 samples scatter by 1 % in the squared errors."""
    grid = Grid.periodic((96, 96), 1, 40.0)
    model = Model(moving_retina.PSF, grid, Planner(folder=None, effort="FFTW_ESTIMATE"))
    frequency = np.hypot(np.fft.fftfreq(96)[:, None], np.fft.rfftfreq(96)[None])
    low, high = band(frequency, np.abs(model.stored) ** 2, 96)
    law, noise_dn = PowerLaw(15.0, 2.0), 3.0
    power = np.exp(law.log_power) * (np.maximum(frequency, low) / np.sqrt(low * high)) ** -law.slope
    eye, sphere = (
        otf(warped(moving_retina.PSF, transform(GEOMETRY, *wavefront)), grid) for wavefront in (EYE, EYE[:1])
    )
    errors, random = np.zeros(2), np.random.default_rng(3)
    for _ in range(40):
        true = np.fft.rfft2(random.standard_normal((96, 96))) / 96 * np.sqrt(power)
        seen = true * eye + np.fft.rfft2(noise_dn * random.standard_normal((96, 96)))
        for k, used in enumerate((eye, sphere)):
            filtered = seen * used.conj() * power / (np.abs(used) ** 2 * power + noise_dn**2 * 96**2)
            errors[k] += np.square(np.fft.irfft2(filtered - true)).sum()
    drawn_db = 10 * np.log10(errors[1] / errors[0])
    assert drawn_db > 0.5
    assert PsfGain(model)(eye, sphere, law, noise_dn) == pytest.approx(drawn_db, rel=0.05)


@dataclass(frozen=True)
class NoTimeToSearch(Deadline):
    """Deadline that leaves time for every step but the search for a refraction, which takes a minute."""

    def fits(self, cost_s: float) -> bool:
        return cost_s < 60


@pytest.mark.parametrize("has_found", [True, False])
def test_a_refraction_that_is_found_already_takes_no_time(counts: Counts, has_found: bool) -> None:
    planner = Planner(folder=None, effort="FFTW_ESTIMATE")
    reconstruct = Reconstructor(CALIBRATION, moving_retina.SHAPE, planner, SystemClock(), timed=False)
    known = KnownRefraction(refraction(None), has_found=has_found)
    made = picture(reconstruct, counts, known, NoTimeToSearch(SystemClock(), 0.0))
    assert (made.report.psf_scale != 1) is has_found
    assert (made.report.refraction_dpt is not None) is has_found


@dataclass
class SlowSearch(KnownRefraction):
    """Task that takes longer than it is waited for, and ends while the picture is made."""

    clock: VirtualClock = field(default_factory=VirtualClock)
    waits_s: list[float] = field(default_factory=list)

    def has_found_by(self, until: Deadline | None) -> bool:
        assert until is not None
        self.waits_s.append(until.left_s())
        self.clock.sleep(until.left_s())
        self.has_found = True
        return False


class SlowRounds:
    """Solver whose rounds take half a second on a virtual clock."""

    def __init__(self, solver: Solver, clock: VirtualClock) -> None:
        self._solver, self._clock = solver, clock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._solver, name)

    def step(self) -> None:
        self._clock.sleep(0.5)
        self._solver.step()


def test_a_slow_search_leaves_the_picture_its_rounds_and_reaches_the_report(counts: Counts) -> None:
    clock = VirtualClock()
    planner = Planner(folder=None, effort="FFTW_ESTIMATE")
    reconstruct = Reconstructor(CALIBRATION, moving_retina.SHAPE, planner, clock, timed=False)
    stage = reconstruct.stages[-1]
    stage.solver = SlowRounds(stage.solver, clock)
    *_, stored = reconstruct.steps(counts, simulated=True, rounds=ROUNDS, eye_psf=EyePsf.STORED)  # measures the rounds
    assert isinstance(stored, Reconstruction)
    begin_s = clock.now_s()
    slow = SlowSearch(refraction(None), has_found=False, clock=clock)
    made = picture(reconstruct, counts, slow, Deadline.after(clock, 10.0))
    assert slow.waits_s == [pytest.approx(10 - RESERVED_ROUNDS * 0.5)]
    assert (made.report.bin, made.report.rounds) == (stage.recipe.bin, RESERVED_ROUNDS)
    assert made.report.psf_scale == 1, "the stored PSF"
    assert made.report.refraction_dpt is not None
    assert clock.now_s() - begin_s <= 10
    assert np.array_equal(made.picture, stored.picture)


def test_a_deadline_does_not_wait_for_the_cylinder(reconstruct: Reconstructor, counts: Counts) -> None:
    late = KnownRefraction(refraction(cylinder()), is_done=False)
    made = picture(reconstruct, counts, late, Deadline.after(SystemClock(), 60))
    assert made.report.psf_cylinder is None
    assert np.array_equal(made.picture, picture(reconstruct, counts, KnownRefraction(refraction(None))).picture)
    early = replace(late, is_done=True)
    assert picture(reconstruct, counts, early, Deadline.after(SystemClock(), 60)).report.psf_cylinder is not None
    assert picture(reconstruct, counts, late).report.psf_cylinder is not None, "without a deadline it waits"


@pytest.mark.parametrize(
    ("found", "is_used"),
    [
        (cylinder(0.15, 0.15), False),  # a gain below 0.03 dB
        (cylinder(0.2, 0.2), True),
        (cylinder(0.6, 0.8, sd_dpt=0.35), False),  # |J| = 1 below 3 sd
        (cylinder(0.6, 0.8, sd_dpt=0.32), True),
    ],
)
def test_a_cylinder_in_doubt_is_not_used(found: Cylinder, is_used: bool) -> None:
    eye = refraction(found).psf_wavefront
    assert eye == (Wavefront(EYE.m_dpt, found.j0_dpt, found.j45_dpt) if is_used else Wavefront(EYE.m_dpt))


def test_a_cylinder_alone_needs_its_psf_and_no_refraction_the_stored_one() -> None:
    plane = replace(refraction(cylinder()), m_dpt=0.01)
    assert plane.psf_wavefront == Wavefront(0.01, EYE.j0_dpt, EYE.j45_dpt)
    assert replace(plane, cylinder=cylinder(0.1, 0.0)).psf_wavefront is None


def test_the_other_frames_of_a_burst_join_the_refraction(reconstruct: Reconstructor, counts: Counts) -> None:
    scatter = FrameScatter(3, 0.12, 0.05)
    task = KnownRefraction(replace(refraction(cylinder()), scatter=scatter))
    *_, made = reconstruct.steps(
        counts,
        simulated=True,
        rounds=1,
        others=[counts, counts],
        refraction=task,  # type: ignore[arg-type]  # a stand-in, whose results need no thread
    )
    assert isinstance(made, Reconstruction)
    assert len(task.others) == 2
    stated = made.report.refraction_scatter
    assert stated == pytest.approx({"frames": 3, "sd_dpt": 0.12, "stated_sd_dpt": 0.05, "chi2": 2 * 2.4**2})
    assert picture(reconstruct, counts, KnownRefraction(refraction(cylinder()))).report.refraction_scatter is None


def test_a_refraction_that_is_refused_with_its_cylinder_leaves_the_sphere_to_the_picture(
    reconstruct: Reconstructor, counts: Counts
) -> None:
    made = picture(reconstruct, counts, KnownRefraction(NoRefraction("no retina explains the frame with this PSF")))
    assert made.report.psf_cylinder is None
    assert made.report.psf_scale == pytest.approx(1 - GEOMETRY.scale_per_dpt * EYE.m_dpt)
    assert made.report.refraction_dpt is not None
    assert made.report.refraction_dpt["refused"] is not None
