"""How much a sample may be off: shot, read and quantisation noise, calibrated or seen where the OTF is empty."""

from dataclasses import dataclass

from device.values import Sensor

LEAST_DN2 = 1e-20  # a black frame has no noise to measure, and is still divided by; float frames may be tiny


@dataclass(frozen=True)
class Noise:
    """Variance of one sample in DN^2: `per_dn` times its value above dark, plus `floor_dn2`."""

    per_dn: float
    floor_dn2: float

    def variance_dn2(self, value_dn: float) -> float:
        """The variance of a sample of that value."""
        return self.per_dn * max(value_dn, 0.0) + self.floor_dn2

    @classmethod
    def of(cls, sensor: Sensor, n: int, measured_dn2: float, mean_dn: float) -> "Noise":
        """Noise of means over n x n pixels (optics.md 3.9): from gain and read noise where they are known.

        Otherwise from `measured_dn2`, the variance that the empty part of the OTF shows: four fifths of it are taken
        for shot noise, so that bright samples count less than dark ones, as they do on any sensor that sees well.
        """
        pixels = n * n
        if sensor.gain_e_per_dn is not None:
            read_dn = (sensor.read_noise_e or 0.0) / sensor.gain_e_per_dn
            return cls(1 / sensor.gain_e_per_dn / pixels, (read_dn**2 + 1 / 12) / pixels)
        shot = 0.8 * measured_dn2 if mean_dn > 0 else 0.0
        return cls(shot / mean_dn if mean_dn > 0 else 0.0, max(measured_dn2 - shot, LEAST_DN2))
