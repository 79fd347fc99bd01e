"""Noise of columns and rows costs little of the picture; frames with rows out of order are refused, not solved."""

from collections import deque
from collections.abc import Callable

import numpy as np
import pytest

from device.errors import FrameError
from device.recon.burst_reconstructor import BurstReconstructor
from device.values import Counts, Reconstruction
from tests import scenes
from tests.hard import defects
from tests.hard.exposed import Exposed, exposed

# PCC. Where the lit disc fills the sensor, no lines without light tell the noise of few cycles over the sensor from the
# light of the retina: about half of its loss remains.
LOST = {"sim": 0.02, "imx296": 0.05}
STEP_LOST = {8000.0: 0.005, 500.0: 0.03}  # PCC; at 500 electrons the size of a step is known to a tenth
REFRACTION_DPT = {8000.0: 0.15, 500.0: 0.35}  # three standard deviations of these frames
PEAK_E = 1000.0  # noise of lines exceeds that of dim pixels only


@pytest.mark.parametrize("head", ["sim", "imx296"])
@pytest.mark.parametrize("name", ["column_noise", "row_noise"])
def test_noise_of_lines_costs_little(head: str, name: str) -> None:
    eye = exposed(head, 0.0, PEAK_E)
    clean = eye.make(eye.frames[0])
    assert not {"column_noise_dn", "row_noise_dn"} & set(clean.report.quality)
    noise = {"column_noise": defects.column_noise, "row_noise": defects.row_noise}[name]
    made = eye.make(noise(eye.frames[0], eye.spec.camera, 0.03))
    assert {"column_noise_dn", "row_noise_dn"} & set(made.report.quality) == {f"{name}_dn"}
    assert eye.pcc(made) > eye.pcc(clean) - LOST[head]
    given = made.report.refraction_dpt
    assert given is not None
    if given["refused"] is None:
        assert abs(given["sphere"]) < 3 * given["sd"]


@pytest.mark.parametrize("head", ["sim", "imx296"])
@pytest.mark.parametrize("of", [defects.repeated_block, defects.repeated_rows, defects.lost_rows])
def test_rows_out_of_order_are_refused(head: str, of: Callable[[Counts, float], Counts]) -> None:
    eye = exposed(head, -4.0, 8000.0)
    with pytest.raises(FrameError, match="rows"):
        eye.make(of(eye.frames[0], 0.022))


def test_dust_is_no_place_where_rows_are_missing() -> None:
    """Of 30 frames with 3 to 19 spots; with a limit for three of eight segments five were refused."""
    eye, rng = exposed("imx296", -4.0, 8000.0), np.random.default_rng(0)
    rows, cols = np.indices(eye.frames[0].shape)
    for _ in range(30):
        share = np.ones(rows.shape, np.float32)
        for _ in range(rng.integers(3, 20)):
            row, col = (rng.uniform(0.1, 0.9) * size for size in rows.shape)
            share[np.hypot(rows - row, cols - col) < rng.uniform(4, 14)] = rng.uniform(0.2, 0.7)
        eye.make.lines(eye.under(share, np.zeros_like(share)))


@pytest.mark.parametrize("index", [0, 2])
def test_a_burst_leaves_out_a_frame_with_repeated_rows(index: int) -> None:
    eye = Exposed("sim", 0.0, 1500.0, frames=4)
    frames = list(eye.frames)
    frames[index] = defects.repeated_block(frames[index], 0.05)
    (made,) = deque(BurstReconstructor(eye.make, scenes.PLANNER).steps(frames, simulated=True), maxlen=1)
    assert isinstance(made, Reconstruction)
    assert [use.used for use in made.report.frames] == [k != index for k in range(4)]
    assert "repeat" in (made.report.frames[index].reason or "")


@pytest.mark.parametrize("head", ["sim", "imx296"])
@pytest.mark.parametrize(("m_dpt", "peak_e"), [(0.0, 8000.0), (-4.0, 8000.0), (3.0, 500.0)])
def test_a_gain_step_costs_neither_picture_nor_refraction_and_is_reported(
    head: str, m_dpt: float, peak_e: float
) -> None:
    eye = exposed(head, m_dpt, peak_e)
    clean = eye.make(eye.frames[0])
    assert "gain_step" not in clean.report.quality
    assert clean.report.refraction_dpt is not None
    columns = np.arange(eye.spec.camera.cols)
    for at, share in ((0.5, 0.03), (0.35, -0.05)):
        gain = np.where(columns < round(at * len(columns)), 1, np.float32(1 + share))
        made = eye.make(eye.under(gain, np.zeros_like(gain)))
        assert eye.pcc(made) > eye.pcc(clean) - STEP_LOST[peak_e]
        assert made.report.quality["gain_step"] == pytest.approx(abs(share), abs=0.004)
        assert [words for words in made.report.warnings if f"at column {round(at * len(columns))}" in words]
        assert made.report.refraction_dpt is not None
        clean_dpt = clean.report.refraction_dpt["sphere"]
        assert made.report.refraction_dpt["sphere"] == pytest.approx(clean_dpt, abs=REFRACTION_DPT[peak_e])
