"""Sensor presets: data-sheet values of a sensor, one TOML file each.

`sensor = "imx296"` in a head's [camera] supplies the values of `sensor_presets/imx296.toml`, and `sensor =
"my_sensor.toml"` those of a file beside the head file; keys of the head file take precedence. The file's name without
`.toml` is the name of the sensor; with the backend picamera2 it is libcamera's name of the chip. Full wells and read
noises with `sure` = false are estimates until a photon transfer measurement (OPTICS.md 1.5 and 5.2).
"""

import difflib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from pydantic import Field

from device.config.toml_file import Table, load_toml
from device.errors import SpecError
from device.user_files import files_in

PRESETS = Path(__file__).with_name("sensor_presets")


class SensorProfile(Table):
    """One sensor at full resolution; `sure` is False where full well or read noise are estimates.

    `black_dn` is the count of a pixel without light. `row_us` is the row time: exposures are multiples of it, and its
    size is the tolerance of their check.
    """

    title: str = Field(min_length=1)
    rows: int = Field(ge=1, le=8192)
    cols: int = Field(ge=1, le=8192)
    pitch_um: float = Field(gt=0, le=100)
    full_well_e: float = Field(gt=0)
    read_noise_e: float = Field(ge=0)
    bit_depth: int = Field(ge=8, le=16)
    black_dn: float = Field(ge=0)
    bayer: bool = False
    global_shutter: bool = False
    sure: bool = False
    row_us: float = Field(default=30.0, gt=0, le=1000)

    @property
    def size_mm(self) -> tuple[float, float]:
        """(long, short) side of the light-sensitive area, mm."""
        sides = self.cols * self.pitch_um / 1000, self.rows * self.pitch_um / 1000
        return max(sides), min(sides)


@cache
def known_sensors() -> Mapping[str, SensorProfile]:
    """Return the presets by name; SpecError names the file and the key of an invalid one."""
    return {path.stem: load_toml(path, SensorProfile) for path in files_in(PRESETS, "*.toml")}


def sensor_profile(name: str, folder: Path) -> SensorProfile:
    """Return the preset of that name, or the one of a TOML file, `name` relative to `folder`.

    SpecError for an unknown name, with the closest known one, and for a file that is missing or invalid.
    """
    if name.endswith(".toml"):
        return load_toml(folder / name, SensorProfile)
    known = known_sensors()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}, or the path of a .toml file"
        raise SpecError(f"no sensor is called {name!r}; {hint}")
    return known[name]
