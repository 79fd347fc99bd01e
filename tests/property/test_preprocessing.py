"""Nonlinearity of the sensor: its inverse in the calibration and in the preprocessing of every frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from device.calibration.procedure.flats import linearised
from device.recon.model.grid import Grid
from device.recon.model.preprocessing import Preprocessor
from device.values import Sensor
from tests.scenes import calibration, delta

WHITE_DN, BLACK_DN = 4095.0, 64.0


@given(st.floats(-0.05, 0.05), st.integers(1, 2), st.booleans())
def test_the_nonlinearity_of_the_sensor_is_inverted(bend: float, n: int, own_dark: bool) -> None:
    light = np.linspace(0, 0.9 * (WHITE_DN - BLACK_DN), 16 * 16, dtype=np.float32).reshape(16, 16)
    per_dn = bend / (WHITE_DN - BLACK_DN)
    counts = (BLACK_DN + light * (1 + np.float32(per_dn) * light)).astype(np.float32)
    sensor = Sensor(black_dn=BLACK_DN, white_dn=WHITE_DN, bend_per_dn=per_dn)
    grid = Grid.periodic((16, 16), n, float("inf"))
    dark = np.full((16, 16), BLACK_DN, np.float32) if own_dark else None
    found = Preprocessor(calibration(delta((16, 16)), sensor=sensor), grid)(counts, dark).y
    expected = light.reshape(16 // n, n, 16 // n, n).mean((1, 3))
    assert found == pytest.approx(expected, rel=8 * abs(bend) ** 3 + 1e-5, abs=1e-3)
    assert linearised(counts - BLACK_DN, per_dn) == pytest.approx(light, rel=8 * abs(bend) ** 3 + 1e-5, abs=1e-3)
