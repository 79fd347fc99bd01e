"""One TOML file describes one head; this turns it into a checked, frozen value or says which line is wrong."""

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from device.errors import SpecError
from device.values import Geometry


class Table(BaseModel):
    """A TOML table: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


T = TypeVar("T", bound=Table)


class CameraSpec(Table):
    """The sensor: which driver answers for it, its pixels, and what its counts mean."""

    backend: Literal["sim", "replay"]
    rows: int = Field(ge=1, le=8192)
    cols: int = Field(ge=1, le=8192)
    pitch_um: float = Field(gt=0, le=100)
    bit_depth: int = Field(default=12, ge=8, le=16)
    black_dn: float = Field(default=64.0, ge=0)
    full_well_e: float = Field(gt=0)
    read_noise_e: float = Field(ge=0)
    exposure_s: float = Field(default=0.1, gt=0, le=10)
    preview_exposure_s: float = Field(default=0.05, gt=0, le=10)

    @property
    def white_dn(self) -> int:
        """The count at which the converter ends."""
        return int(2**self.bit_depth) - 1

    @property
    def gain_e_per_dn(self) -> float:
        """Electrons per count, when a full well reaches the converter's end."""
        return self.full_well_e / (self.white_dn - self.black_dn)


class LightSpec(Table):
    """The LED ring: colours for the picture and for aiming, and how long the guard lets it shine at once."""

    backend: Literal["sim", "replay"]
    colour: Literal["red", "green", "blue"] = "green"
    preview_colour: Literal["red", "green"] = "red"
    max_on_s: float = Field(default=1.0, gt=0, le=30)


class OpticsSpec(Table):
    """The light path from the eye to the sensor: paper, sections "Optical design" and "Hardware design"."""

    iris_um: float = Field(gt=0)
    diffuser_to_sensor_um: float = Field(gt=0)
    angular_magnification: float = Field(gt=0)
    field_deg: float = Field(gt=0, lt=180)
    wavelength_um: float = Field(default=0.55, gt=0.3, lt=1.2)
    bandwidth_um: float = Field(default=0.04, ge=0, lt=0.2)
    slope_fwhm_deg: float = Field(default=0.5, gt=0, lt=20)
    correlation_um: float = Field(default=70.0, gt=0)

    def geometry(self, pitch_um: float) -> Geometry:
        """How degrees become pixels on a sensor with that pitch."""
        return Geometry(pitch_um, self.diffuser_to_sensor_um, self.angular_magnification)


class SimSpec(Table):
    """What the simulated head looks at: a procedural fundus, or an image file of one."""

    seed: int = 1
    peak_e: float = Field(default=15000.0, gt=0)
    haemorrhages: int = Field(default=0, ge=0)
    microaneurysms: int = Field(default=0, ge=0)
    exudates: int = Field(default=0, ge=0)
    image: Path | None = None


class ReplaySpec(Table):
    """Which recordings a replayed head plays: raws in turn, one PSF or a stack, relative to the file."""

    raws: tuple[Path, ...] = Field(min_length=1)
    psfs: tuple[Path, ...] = Field(min_length=1)
    black_dn: float = 0.0
    dark: Path | None = None
    flat: Path | None = None


class InstrumentSpec(Table):
    """A whole head. `sim` and `replay` hold what only that backend needs."""

    name: str = Field(min_length=1)
    camera: CameraSpec
    light: LightSpec
    optics: OpticsSpec | None = None
    sim: SimSpec | None = None
    replay: ReplaySpec | None = None


def load_toml(path: Path, kind: type[T]) -> T:
    """Read a TOML file as a `kind`; SpecError names the file, the line and the key of the first mistake."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"{path} cannot be read: {error}", "Give the path of a readable TOML file.") from error
    try:
        return kind.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"{path} is not TOML: {error}") from error
    except ValidationError as error:
        raise SpecError(_sentence(path, text, _most_telling(error), kind)) from error


def _most_telling(error: ValidationError) -> Any:
    """The mistake to name: a key that is not known comes first, because it is why another one is missing."""
    mistakes = error.errors()
    return next((mistake for mistake in mistakes if mistake["type"] == "extra_forbidden"), mistakes[0])


def load_head(path: Path) -> InstrumentSpec:
    """Read a head TOML (`hardware/heads/*.toml`); a missing table that its backends need is refused."""
    spec = load_toml(path, InstrumentSpec)
    if "sim" in (spec.camera.backend, spec.light.backend) and (spec.sim is None or spec.optics is None):
        raise SpecError(f"{path}: a simulated head needs the tables [optics] and [sim]")
    if spec.camera.backend == "replay" and spec.replay is None:
        raise SpecError(f"{path}: a replayed head needs the table [replay]")
    for key in ("exposure_s", "preview_exposure_s"):
        if getattr(spec.camera, key) >= spec.light.max_on_s:
            raise SpecError(
                f"{path}: camera.{key} = {getattr(spec.camera, key):g} is not shorter than "
                f"light.max_on_s = {spec.light.max_on_s:g}, so the guard would end every exposure"
            )
    return spec


def _sentence(path: Path, text: str, error: Any, kind: type[Table]) -> str:
    keys = [str(part) for part in error["loc"]]
    lines = (line_of(text, keys[:length]) for length in range(len(keys), 0, -1))  # of the key, or what it stands in
    line = next((line for line in lines if line), None)
    where = f"{path}, line {line}" if line else str(path)
    if error["type"] != "extra_forbidden":
        return f"{where}: {'.'.join(keys)}: {error['msg']}"
    near = difflib.get_close_matches(keys[-1], _known_keys(kind, keys[:-1]), n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{where}: '{'.'.join(keys)}' is not a known key{hint}"


def _known_keys(kind: type[Table], tables: list[str]) -> list[str]:
    for table in tables:
        annotation = kind.model_fields[table].annotation
        options = [annotation, *getattr(annotation, "__args__", ())]
        kind = next(option for option in options if isinstance(option, type) and issubclass(option, Table))
    return list(kind.model_fields)


def line_of(text: str, keys: list[str]) -> int | None:
    """The line of a TOML text (counted from 1) on which a key stands, or its table's, if it is missing."""
    table, found = "", None
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*\[+\s*([^\]]+?)\s*\]+", line):
            table = header[1]
            if table == ".".join(keys) or table == ".".join(keys[:-1]):
                found = found or number
        elif (entry := re.match(r"\s*['\"]?([\w.-]+)['\"]?\s*=", line)) and (
            f"{table}.{entry[1]}".lstrip(".") == ".".join(keys)
        ):
            return number
    return found
