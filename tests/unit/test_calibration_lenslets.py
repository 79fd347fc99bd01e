"""Whole calibration of a simulated head with lenslets, by the same sequence as that of a diffuser's head."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device.calibration.procedure.calibration_sequence import CalibrationJob
from device.calibration.procedure.dioptres import fit_similarity
from device.calibration.procedure.point_source import MotionCheck, centroid_px
from device.calibration.procedure.spot_similarity import fit_spots
from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, OpticsSpec, load_head
from device.recon.model.spots import find_spots
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import calibration_point
from device.sim.world import World
from device.values import Frame, Image, Psf
from services import resources
from tests.paper.bench import with_changes
from tests.simulated import coarse
from tests.unit.test_calibration_measurements import refusal_message
from tests.unit.test_calibration_sequence import CalibrationBench


@cache
def head(**flaws: Any) -> InstrumentSpec:
    changes = {"sim.eye.focal_length_um": 25000.0} | {f"optics.element.{key}": value for key, value in flaws.items()}
    return coarse(with_changes(load_head(resources.HEADS / "sim_imx296_lenslets.toml"), changes), 2)


def optics(spec: InstrumentSpec) -> OpticsSpec:
    assert spec.optics is not None
    return spec.optics


@cache
def point(moved_mm: float = 0.0) -> Psf:
    world = World(head(), VirtualClock())
    return Psf(crop_or_pad(calibration_point(world, moved_mm), world.shape))


def test_centroid_of_spots_is_the_axis_also_in_noise() -> None:
    """The light of a spot is in proportion to its cell: together they have the middle of the iris."""
    light = point().pixels / point().pixels.max()
    noise = 0.001 * np.random.default_rng(1).standard_normal(light.shape).astype(np.float32)
    off_px = np.array(centroid_px(light + noise)) - np.array(light.shape) // 2
    assert np.abs(off_px).max() < 0.6


@pytest.mark.parametrize("moved_px", [(0, 0), (1, 0), (-3, 20)], ids=str)
def test_moved_source_is_found_beside_the_shot_noise_of_the_spots(moved_px: tuple[int, int]) -> None:
    light_e = np.roll(point_e(), moved_px, (0, 1))
    rng = np.random.default_rng(2)
    frames = [np.round(rng.poisson(np.maximum(light, 0)) / 10) for light in (point_e(), point_e(), light_e)]
    check = MotionCheck(np.zeros(light_e.shape, np.float32)).watch(map(frame, frames))
    if moved_px == (0, 0):
        assert len(list(check)) == 3
    else:
        assert f"moved by {np.hypot(*moved_px):.1f} pixels" in refusal_message(list, check)


def point_e() -> Image:
    return point().pixels * np.float32(30_000 / point().pixels.max())


def frame(counts: Image) -> Frame:
    return Frame(counts.astype(np.uint16), 0.1, 1, None, simulated=True)


@pytest.mark.parametrize(("moved_mm", "m_dpt"), [(-4.0, -7.62), (2.0, 2.96), (4.0, 5.52)])
def test_source_that_moves_along_the_axis_moves_the_spots_by_its_dioptres(moved_mm: float, m_dpt: float) -> None:
    """A stretched PSF stays in focus; the places of the spots follow 1 - k M, and their defocus is the model's."""
    geometry = optics(head()).geometry(6.9)
    moved = Psf(np.roll(point(moved_mm).pixels, (1, -2), (0, 1)))
    found = fit_similarity(point(), moved, 6.9, geometry)
    assert 1 - found.scale == pytest.approx(m_dpt * geometry.scale_per_dpt, abs=0.1 * geometry.scale_per_dpt)
    assert found.moved_px == pytest.approx((1, -2), abs=0.3)
    assert found.correlation > 0.95


def test_spots_of_other_lenslets_have_no_similarity() -> None:
    geometry = optics(head()).geometry(6.9)
    mirrored = Psf(np.ascontiguousarray(point().pixels[:, ::-1]))
    found = fit_spots(point(), mirrored, geometry)
    assert found is None or found[2] < 0.5


def test_whole_calibration_of_lenslets_finds_them_and_what_has_become_of_them(tmp_path: Path) -> None:
    """The second calibration is of a plate with a missing lens, clear gaps, and centres moved along the rows."""
    bench = CalibrationBench(tmp_path, World(head(), VirtualClock()))
    job = CalibrationJob(bench.world.spec, "D-1", "a technician", "0.1.0", dioptres=True)
    kept = bench.archive.load(bench.calibrate(job))
    figures, geometry = dict(kept.provenance.figures), kept.calibration.geometry
    assert geometry is not None
    assert geometry.scale_per_dpt == pytest.approx(geometry.nominal_scale_per_dpt, rel=0.01)
    assert figures["lenses_without_spot"] == 0
    assert figures["lens_light_beside"] < 0.02
    spots = find_spots(kept.calibration.psfs[0], geometry)
    assert spots is not None
    assert len(spots.light) == 22
    assert not [line for line in bench.messages if "lens" in line]
    lenses = optics(head()).element.lenses
    moved = tuple((x_um + 3 * (-1) ** n, y_um, focal_um) for n, (x_um, y_um, focal_um) in enumerate(lenses) if n != 4)
    bench.world = World(head(lenses=moved, aperture_um=520.0, gaps="clear"), VirtualClock())
    again = bench.archive.load(bench.calibrate(CalibrationJob(head(), "D-1", "a technician", "0.1.0")))
    assert dict(again.provenance.figures)["lens_moved_um"] == pytest.approx(3 / 2**0.5, rel=0.3)
    shown = " ".join(bench.messages)
    assert "lenses without a spot of their own: 1" in shown
    assert "passes beside the lenses" in shown
    assert "have moved by" in shown
