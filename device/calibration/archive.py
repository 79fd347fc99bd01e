"""Content-addressed archive of calibrations: one folder each, atomic writes, and a check of every byte on load.

    ROOT/<id>/manifest.toml     a seal over the rest of it, the numbers, provenance, and the SHA-256 of each array
    ROOT/<id>/psf0.npy ...      the arrays
    ROOT/current                the id of the active calibration

A calibration is never changed. A new one is written beside the old ones and activated by one rename; a rollback is the
same rename. After a power cut at any moment the old or the new calibration is active, whole.
"""

import hashlib
import io
import re
import shutil
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from math import isfinite
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w
from pydantic import TypeAdapter

from device import atomic_io
from device.errors import (
    CalibrationDamaged,
    CalibrationError,
    CalibrationFormat,
    CalibrationMissing,
    StoreError,
    StoreFull,
)
from device.user_files import files_in
from device.values import Calibration, Colour, Geometry, Psf, RefractionOffset, Sensor, WhiteReference

MANIFEST, CURRENT = "manifest.toml", "current"
MAPS = ("dark_dn", "flat", "bad")
FORMAT = 1
ID = re.compile("[0-9a-f]{16}")
NAME = re.compile(r"[a-z][a-z0-9_]*\.(npy|toml)")


@dataclass(frozen=True)
class Provenance:
    """Origin of a calibration: head serial, date, person, software, head temperature, and additional measured figures.

    `origin` is "imported" for a PSF from another laboratory, and `source` names that laboratory; `unknown` lists the
    unknown fields of `Calibration` and `Sensor`, whose values are placeholders. `meter` names the radiometer of the
    LEDs and its date.
    """

    serial: str
    made_at: datetime
    made_by: str
    software: str
    temperature_c: float | None = None
    figures: tuple[tuple[str, float], ...] = ()
    origin: Literal["measured", "imported"] = "measured"
    source: str | None = None
    unknown: tuple[str, ...] = ()
    meter: str | None = None


@dataclass(frozen=True)
class StoredCalibration:
    """Calibration with its provenance."""

    calibration: Calibration
    provenance: Provenance


class Archive:
    """Calibrations below one folder, which is created with the first calibration."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def add_and_activate(self, calibration: Calibration, provenance: Provenance) -> str:
        """Store a calibration, activate it and return its id; one that is stored already is only activated."""
        id = self.add(calibration, provenance)
        self.activate(id)
        return id

    def add(self, calibration: Calibration, provenance: Provenance) -> str:
        """Store a calibration without activating it and return its id; StoreError, StoreFull."""
        return self.add_files(_files(calibration, provenance))

    def add_files(self, files: Mapping[str, bytes]) -> str:
        """Store the files of a calibration unchanged, without activating it, and return its id.

        The files are checked first, as in `load`; an intact calibration with the same id is left as it is. The write is
        atomic: after a power cut the archive has all of the files or none.
        """
        id = parse_calibration(files).calibration.id
        with self._locked():
            for left in self.root.glob(".part*"):  # left by a power cut
                shutil.rmtree(left)
            place = self.root / id
            if not self._is_whole(id):
                shutil.rmtree(place, ignore_errors=True)
                part = Path(tempfile.mkdtemp(prefix=".part", dir=self.root))
                try:
                    for name, content in files.items():
                        atomic_io.write_file(part / name, content)
                    atomic_io.fsync_folder(part)
                    atomic_io.replace_durably(part, place)
                except BaseException:
                    shutil.rmtree(part, ignore_errors=True)
                    raise
        return id

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the archive's file lock (flock), a mutex between processes; OSError becomes StoreError or StoreFull."""
        try:
            atomic_io.make_folder(self.root)
            with atomic_io.file_lock(self.root / ".lock"):
                yield
        except OSError as error:
            full = StoreFull if atomic_io.is_full(error) else StoreError
            raise full(
                f"{self.root} cannot be written: {error.strerror or error}",
                "Make room there or choose another folder; the calibrations that were kept are as before.",
            ) from error

    def activate(self, id: str) -> None:
        """Activate a stored calibration, after reading and checking it; errors as in `load`, StoreError."""
        self.load(id)
        with self._locked():
            atomic_io.write_atomically(self.root / CURRENT, id.encode("ascii"))

    def load(self, id: str | None = None) -> StoredCalibration:
        """Return the active calibration, or the one with this id.

        Raises CalibrationMissing, CalibrationDamaged at one wrong byte, or CalibrationFormat for an unknown format
        version.
        """
        id = id or self.active_id()
        return _read(_read_files(self._folder_of(id)), id)

    def files(self, id: str) -> dict[str, bytes]:
        """Return the files that a stored calibration's manifest names, and the manifest, as bytes by name, checked."""
        found = _read_files(self._folder_of(id))
        _read(found, id)
        return {name: found[name] for name in (MANIFEST, *_parse_manifest(found)["sha256"])}

    def _folder_of(self, id: str) -> Path:
        if not ID.fullmatch(id) or not (self.root / id).is_dir():
            raise CalibrationMissing(
                f"there is no calibration {id} in {self.root}",
                "See `diffuscope calibrations list` for those that are kept.",
            )
        return self.root / id

    def _is_whole(self, id: str) -> bool:
        try:
            self.load(id)
        except CalibrationError:
            return False
        return True

    def active_id(self) -> str:
        """Return the id of the active calibration; CalibrationMissing if none, CalibrationDamaged if it is no id."""
        path = self.root / CURRENT
        if not path.is_file():
            remedy = "Choose one with `diffuscope calibrations use`." if self.ids() else None
            raise CalibrationMissing(f"no calibration is in force in {self.root}", remedy)
        id = path.read_bytes().decode("ascii", "replace")
        if not ID.fullmatch(id):
            raise CalibrationDamaged(
                f"{path} does not hold the name of a calibration", "Choose one with `diffuscope calibrations use`."
            )
        return id

    def ids(self) -> tuple[str, ...]:
        """Return the ids of all stored calibrations, damaged ones included, oldest folder first (modification time)."""
        if not self.root.is_dir():
            return ()
        found = [place for place in files_in(self.root) if ID.fullmatch(place.name) and place.is_dir()]
        return tuple(place.name for place in sorted(found, key=lambda place: place.stat().st_mtime_ns))


def _files(calibration: Calibration, provenance: Provenance) -> dict[str, bytes]:
    arrays = {f"psf{k}.npy": psf.pixels for k, psf in enumerate(calibration.psfs)}
    arrays |= {f"{name}.npy": array for name in MAPS if (array := getattr(calibration, name)) is not None}
    found = {name: _npy(array) for name, array in arrays.items()}
    found[MANIFEST] = sealed(tomli_w.dumps(_without_none(_manifest(calibration, provenance, found))))
    return found


def parse_calibration(files: Mapping[str, bytes]) -> StoredCalibration:
    """Return the calibration in these files; CalibrationDamaged unless they are exactly one whole calibration.

    CalibrationFormat for an unknown format version. No path named in the files is opened.
    """
    try:
        manifest = _parse_manifest(files)
        id = str(manifest["id"])
        names = {MANIFEST, *manifest["sha256"]}
    except _PARSE_ERRORS as error:
        raise CalibrationDamaged(f"this is not a whole calibration: {error}") from error
    if set(files) != names or not all(NAME.fullmatch(name) for name in names):
        raise CalibrationDamaged("this calibration holds other files than its manifest names")
    return _read(files, id)


def _manifest(calibration: Calibration, provenance: Provenance, arrays: dict[str, bytes]) -> dict[str, Any]:
    table = asdict(provenance) | {"made_at": provenance.made_at.isoformat(), "figures": None}
    table["unknown"] = list(provenance.unknown)
    return {
        "format": FORMAT,
        "id": calibration.id,
        "simulated": calibration.simulated,
        "field_deg": calibration.field_deg,
        "psf_names": [psf.name for psf in calibration.psfs],
        "psf_colours": [psf.colour or "every" for psf in calibration.psfs],
        "sensor": asdict(calibration.sensor),
        "geometry": asdict(calibration.geometry) if calibration.geometry else None,
        "refraction_offset": asdict(calibration.refraction_offset) if calibration.refraction_offset else None,
        "white": dict(calibration.white.dn_per_s) if calibration.white else None,
        "source_in_focus": calibration.source_in_focus or None,
        "soft_edge_deg": calibration.soft_edge_deg,
        "provenance": table,
        "figures": dict(provenance.figures),
        "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in arrays.items()},
    }


def _read_files(place: Path) -> dict[str, bytes]:
    try:
        return {path.name: path.read_bytes() for path in files_in(place) if path.is_file()}
    except OSError as error:
        raise CalibrationDamaged(f"calibration {place.name} cannot be read: {error.strerror}") from error


def _parse_manifest(files: Mapping[str, bytes]) -> dict[str, Any]:
    manifest = tomllib.loads(unsealed(_required_file(files, MANIFEST)))
    if manifest["format"] != FORMAT:
        raise CalibrationFormat(f"this calibration was kept in format {manifest['format']}; known here is {FORMAT}")
    return manifest


def _required_file(files: Mapping[str, bytes], name: str) -> bytes:
    if name not in files:
        raise ValueError(f"{name} is missing")
    return files[name]


def _read(files: Mapping[str, bytes], id: str) -> StoredCalibration:
    try:
        manifest = _parse_manifest(files)
        arrays = {name: _array(_required_file(files, name), digest) for name, digest in manifest["sha256"].items()}
        calibration = Calibration(
            psfs=tuple(
                Psf(arrays[f"psf{k}.npy"], str(name), None if colour == "every" else _COLOUR.validate_python(colour))
                for k, (name, colour) in enumerate(zip(manifest["psf_names"], manifest["psf_colours"], strict=True))
            ),
            sensor=Sensor(**_numbers(manifest["sensor"])),
            geometry=Geometry(**_numbers(manifest["geometry"])) if "geometry" in manifest else None,
            field_deg=_numbers({"field_deg": manifest.get("field_deg")})["field_deg"],
            simulated=_BOOL.validate_python(manifest["simulated"]),
            refraction_offset=_offset(manifest.get("refraction_offset")),
            white=_white(manifest.get("white")),
            source_in_focus=_BOOL.validate_python(manifest.get("source_in_focus", False)),
            soft_edge_deg=_soft_edge(manifest.get("soft_edge_deg")),
            **{name: _checked_map(arrays.get(f"{name}.npy"), name) for name in MAPS},
        )
        figures = tuple(manifest["figures"].items())
        provenance = _PROVENANCE.validate_python(manifest["provenance"] | {"figures": figures})
        stored = StoredCalibration(calibration, provenance)
    except _PARSE_ERRORS as error:
        raise CalibrationDamaged(f"calibration {id}: {error}") from error
    if stored.calibration.id != id:
        raise CalibrationDamaged(f"calibration {id} holds {stored.calibration.id}")
    return stored


_BOOL = TypeAdapter(bool)
_NUMBERS = TypeAdapter(dict[str, float | None])
_PROVENANCE = TypeAdapter(Provenance)
_COLOUR: TypeAdapter[Colour] = TypeAdapter(Colour)
_WHITE: TypeAdapter[dict[Colour, float]] = TypeAdapter(dict[Colour, float])
_PARSE_ERRORS = (ValueError, LookupError, TypeError, AttributeError, EOFError, MemoryError, RecursionError)


def _numbers(table: dict[str, Any]) -> dict[str, Any]:
    """Return the table unchanged; ValueError unless all values are numbers or None. Their digits are part of the id."""
    _NUMBERS.validate_python(table, strict=True)
    return table


def _offset(table: dict[str, Any] | None) -> RefractionOffset | None:
    """Return the refraction offset of a manifest; None without one. ValueError unless all values are finite numbers."""
    if table is None:
        return None
    offset = RefractionOffset(**_numbers(table))
    if not all(isinstance(value, int | float) and isfinite(value) for value in asdict(offset).values()):
        raise ValueError("the refraction offset holds a value that is no number")
    return offset


def _white(table: dict[str, Any] | None) -> WhiteReference | None:
    """Return the white reference of a manifest; None without one. ValueError unless all lights are above 0."""
    if table is None:
        return None
    lights = _WHITE.validate_python(table)
    if not all(isfinite(value) and value > 0 for value in lights.values()):
        raise ValueError("the white reference holds a value that is no light")
    return WhiteReference(tuple(lights.items()))


def _soft_edge(pair: Any) -> tuple[float, float] | None:
    """Return the soft edge of a manifest; None without one. ValueError unless both angles are finite and above 0."""
    if pair is None:
        return None
    diameter_deg, width_deg = _numbers(dict(zip(("diameter_deg", "width_deg"), pair, strict=True))).values()
    if not (isfinite(diameter_deg) and isfinite(width_deg) and min(diameter_deg, width_deg) > 0):
        raise ValueError("the soft edge of the field holds a value that is no angle")
    return diameter_deg, width_deg


def _checked_map(array: np.ndarray | None, name: str) -> np.ndarray | None:
    """Return the array or None; ValueError unless it is (rows, cols), bool for `bad` and float32 for other maps."""
    if array is not None and (array.ndim != 2 or array.dtype != (np.bool_ if name == "bad" else np.float32)):
        raise ValueError(f"{name} holds {array.dtype} of the shape {array.shape}, which is no map of a sensor")
    return array


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array, allow_pickle=False)
    return out.getvalue()


def _array(content: bytes, digest: str) -> np.ndarray:
    if hashlib.sha256(content).hexdigest() != digest:
        raise ValueError("a file is not what was kept")
    array: np.ndarray = np.load(io.BytesIO(content), allow_pickle=False)
    return array


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    """Return a table without None, which TOML has no value for, also in its inner tables."""
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in table.items()
        if value is not None
    }


def sealed(text: str) -> bytes:
    """Return the text as UTF-8 after a first line with its SHA-256."""
    body = text.encode("utf-8")
    return f'seal = "{hashlib.sha256(body).hexdigest()}"\n'.encode("ascii") + body


def unsealed(content: bytes) -> str:
    """Return the text after the seal line; ValueError if its SHA-256 does not match."""
    head, _, body = content.partition(b"\n")
    if head != f'seal = "{hashlib.sha256(body).hexdigest()}"'.encode("ascii"):
        raise ValueError("the manifest is not what was kept")
    return body.decode("utf-8")
