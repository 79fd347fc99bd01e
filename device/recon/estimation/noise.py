"""Noise model of a sample: shot, read and quantisation noise, from the calibration or from the stopband of the OTF."""

from dataclasses import dataclass

from device.values import Sensor

DITHERING_SD = 0.5  # counts
MIN_DN2 = 1e-20  # lower limit against a division by 0 for a black frame; float frames may be tiny


@dataclass(frozen=True)
class Noise:
    """Variance of one sample in DN^2: `per_dn` times its value above dark, plus `floor_dn2`."""

    per_dn: float
    floor_dn2: float

    def variance_dn2(self, value_dn: float) -> float:
        """Return the variance in DN^2 of a sample of `value_dn` above dark."""
        return self.per_dn * max(value_dn, 0.0) + self.floor_dn2

    def dithered_dn(self, n: int) -> float:
        """Return the light in DN from which on a pixel's noise dithers the rounding of its counts, for n x n pixels.

        Rounding shifts the mean of counts with a noise of sd s by up to exp(-2 pi^2 s^2) / pi (Widrow and Kollar 2008):
        by 0.002 counts where s is DITHERING_SD, and to 0 a light of a tenth of a count where s is small.
        """
        pixel = n * n
        rest_dn2 = max(self.floor_dn2 * n * n - 1 / 12, 0.0)
        return max(DITHERING_SD**2 - rest_dn2, 0.0) / (self.per_dn * pixel) if self.per_dn > 0 else 0.0

    @classmethod
    def of(cls, sensor: Sensor, n: int, measured_dn2: float, mean_dn: float) -> "Noise":
        """Return the noise of means over n x n pixels (NUMERICS.md 2.1).

        It comes from gain and read noise if the gain is known. Otherwise it comes from `measured_dn2`, the variance of
        a sample from the stopband of the OTF, at the mean light `mean_dn` above dark: four fifths of it are attributed
        to shot noise, so that bright samples have less weight than dark ones, as on any sensor limited by shot noise.
        """
        pixels = n * n
        if sensor.gain_e_per_dn is not None:
            read_dn = (sensor.read_noise_e or 0.0) / sensor.gain_e_per_dn
            return cls(1 / sensor.gain_e_per_dn / pixels, (read_dn**2 + 1 / 12) / pixels)
        shot = 0.8 * measured_dn2 if mean_dn > 0 else 0.0
        return cls(shot / mean_dn if mean_dn > 0 else 0.0, max(measured_dn2 - shot, MIN_DN2))
