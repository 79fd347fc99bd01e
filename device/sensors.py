"""Sensors that this instrument has been thought through with: what their data sheets say, as heads name them.

`sensor = "imx296"` in a head's [camera] fills in these values; what the head says itself goes before. Wells and read
noises marked with a question are guesses until a photon transfer curve says otherwise (optics.md 1.5, 10).
"""

from typing import NamedTuple


class SensorProfile(NamedTuple):
    """One sensor at full resolution; `sure` is False where well or read noise are guesses."""

    title: str
    rows: int
    cols: int
    pitch_um: float
    full_well_e: float
    read_noise_e: float
    bit_depth: int
    black_dn: float
    bayer: bool
    global_shutter: bool
    sure: bool
    row_us: float = 30.0  # time of a row: exposures are whole rows, within which they are compared

    @property
    def size_mm(self) -> tuple[float, float]:
        """(long, short) side of the light-sensitive area."""
        sides = self.cols * self.pitch_um / 1000, self.rows * self.pitch_um / 1000
        return max(sides), min(sides)


SENSORS: dict[str, SensorProfile] = {
    "quantalux": SensorProfile(
        "Thorlabs Quantalux sCMOS (paper)", 1080, 1920, 5.04, 23000, 1.03, 12, 64, False, False, True
    ),
    "imx296": SensorProfile(
        "Sony IMX296, Pi Global Shutter", 1088, 1456, 3.45, 10000, 2.2, 12, 60, False, True, False, 14.8
    ),
    "imx477": SensorProfile("Sony IMX477, Pi HQ", 3040, 4056, 1.55, 8180, 3.0, 12, 256, True, False, True),
    "imx500": SensorProfile("Sony IMX500, Pi AI", 3040, 4056, 1.55, 8180, 3.0, 10, 64, True, False, False),
    "imx283": SensorProfile("Sony IMX283, 1 inch", 3694, 5496, 2.4, 15000, 3.0, 12, 50, True, False, False),
    "imx585": SensorProfile("Sony IMX585, Starvis 2, mono", 2180, 3856, 2.9, 38000, 1.0, 12, 50, False, False, False),
    "imx708": SensorProfile("Sony IMX708, Pi Camera 3", 2592, 4608, 1.4, 6000, 2.5, 10, 64, True, False, False),
    "imx519": SensorProfile("Sony IMX519", 3496, 4656, 1.22, 5000, 2.5, 10, 64, True, False, False),
    "imx219": SensorProfile("Sony IMX219, Pi Camera 2", 2464, 3280, 1.12, 4300, 2.5, 10, 64, True, False, False),
    "ov9281": SensorProfile("OmniVision OV9281, mono", 800, 1280, 3.0, 10000, 5.0, 10, 16, False, True, False),
    "ov2311": SensorProfile("OmniVision OV2311, mono", 1300, 1600, 3.0, 8000, 4.0, 10, 16, False, True, False),
    "ar0234": SensorProfile("onsemi AR0234, mono", 1200, 1920, 3.0, 10000, 5.0, 10, 42, False, True, False),
}
