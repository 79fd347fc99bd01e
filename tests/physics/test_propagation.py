"""Angular spectrum propagation against closed forms."""

import numpy as np
import pytest

from device.errors import SpecError
from device.optics.propagation import propagate, require_sampling, transfer

N, DX_UM, WAVE_UM = 512, 4.0, 0.55


def axis():
    return (np.arange(N) - N // 2) * DX_UM


def gaussian_beam(waist_um):
    x = axis()
    return np.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / waist_um**2).astype(np.complex64)


def rms_width_um(intensity):
    x = axis()
    return float(np.sqrt((intensity * x[None, :] ** 2).sum() / intensity.sum()))


@pytest.mark.parametrize("distance_um", [1000.0, 6000.0, 20000.0])
def test_the_width_of_a_gaussian_beam_equals_its_closed_form(distance_um):
    waist = 60.0
    got = rms_width_um(np.abs(propagate(gaussian_beam(waist), DX_UM, WAVE_UM, distance_um)) ** 2)
    rayleigh = np.pi * waist**2 / WAVE_UM
    assert got == pytest.approx(waist / 2 * np.hypot(1, distance_um / rayleigh), rel=1e-3)


def test_energy_is_conserved():
    beam = gaussian_beam(40.0)
    after = propagate(beam, DX_UM, WAVE_UM, 6000.0)
    assert (np.abs(after) ** 2).sum() == pytest.approx((np.abs(beam) ** 2).sum(), rel=1e-5)


def test_back_propagation_restores_the_field():
    rng = np.random.default_rng(0)
    field = gaussian_beam(150.0) * np.exp(1j * rng.standard_normal((N, N))).astype(np.complex64)
    back = propagate(propagate(field, DX_UM, WAVE_UM, 6000.0), DX_UM, WAVE_UM, -6000.0)
    assert np.abs(back - field).max() < 1e-5


def test_a_tilted_beam_shifts_by_its_angle():
    distance, shift_px = 6000.0, 20
    sine = np.sin(np.arctan(shift_px * DX_UM / distance))
    tilt = np.exp(2j * np.pi * sine / WAVE_UM * axis()[None, :]).astype(np.complex64)
    straight = np.abs(propagate(gaussian_beam(60.0), DX_UM, WAVE_UM, distance)) ** 2
    tilted = np.abs(propagate(gaussian_beam(60.0) * tilt, DX_UM, WAVE_UM, distance)) ** 2
    assert np.corrcoef(np.roll(straight, shift_px, 1).ravel(), tilted.ravel())[0, 1] > 0.9999


def test_evanescent_waves_vanish():
    spectrum = transfer(64, 0.2, WAVE_UM, 100.0)
    f = np.fft.fftfreq(64, 0.2)
    fast = np.hypot(f[:, None], f[None, :]) * WAVE_UM > 1
    assert fast.any()
    assert not spectrum[fast].any()
    assert np.abs(spectrum[~fast]) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("samples", "dx_um", "words"),
    [(1024, 20.0, "cannot hold rays"), (512, 5.0, "too small"), (4000, 0.9, "transfer function")],
)
def test_an_undersampled_grid_is_refused(samples, dx_um, words):
    with pytest.raises(SpecError, match=words):
        require_sampling(samples, dx_um, wavelength_um=0.55, distance_um=6000.0, aperture_um=3200.0, angle_rad=0.0185)


def test_the_papers_grid_is_accepted():
    require_sampling(1024, 5.04, wavelength_um=0.55, distance_um=6000.0, aperture_um=3200.0, angle_rad=0.0185)
