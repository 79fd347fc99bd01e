"""Noise of columns and rows costs little of the picture; frames with rows out of order are refused, not solved."""

from collections import deque
from collections.abc import Callable

import pytest

from device.errors import FrameError
from device.recon.burst_reconstructor import BurstReconstructor
from device.values import Counts, Reconstruction
from tests import scenes
from tests.hard import defects
from tests.hard.exposed import Exposed, exposed

LOST = 0.02  # PCC
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
    assert eye.pcc(made) > eye.pcc(clean) - LOST


@pytest.mark.parametrize("head", ["sim", "imx296"])
@pytest.mark.parametrize("of", [defects.repeated_block, defects.repeated_rows, defects.lost_rows])
def test_rows_out_of_order_are_refused(head: str, of: Callable[[Counts, float], Counts]) -> None:
    eye = exposed(head, -4.0, 8000.0)
    with pytest.raises(FrameError, match="rows"):
        eye.make(of(eye.frames[0], 0.022))


@pytest.mark.parametrize("index", [0, 2])
def test_a_burst_leaves_out_a_frame_with_repeated_rows(index: int) -> None:
    eye = Exposed("sim", 0.0, 1500.0, frames=4)
    frames = list(eye.frames)
    frames[index] = defects.repeated_block(frames[index], 0.05)
    (made,) = deque(BurstReconstructor(eye.make, scenes.PLANNER).steps(frames, simulated=True), maxlen=1)
    assert isinstance(made, Reconstruction)
    assert [use.used for use in made.report.frames] == [k != index for k in range(4)]
    assert "repeat" in (made.report.frames[index].reason or "")
