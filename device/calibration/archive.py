"""Where calibrations are kept: one folder for each, named by its content, whole or not there, every byte checked.

    ROOT/<id>/manifest.toml     a seal over the rest of it, the numbers, who and when, and the SHA-256 of each array
    ROOT/<id>/psf0.npy ...      the arrays
    ROOT/current                the id that is in force

A calibration is never changed. A new one is written beside the old ones and takes effect by one rename; to go back is
the same rename. A power cut at any moment leaves the old one in force, or the new one, whole.
"""

import errno
import fcntl
import hashlib
import io
import json
import os
import re
import shutil
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter

from device.errors import (
    CalibrationDamaged,
    CalibrationError,
    CalibrationFormat,
    CalibrationMissing,
    StoreError,
    StoreFull,
)
from device.values import Calibration, Colour, Geometry, Psf, Sensor

MANIFEST, CURRENT = "manifest.toml", "current"
MAPS = ("dark_dn", "flat", "bad")
FORMAT = 1
ID, NAME = re.compile("[0-9a-f]{16}"), re.compile(r"[a-z][a-z0-9_]*\.(npy|toml)")


@dataclass(frozen=True)
class Provenance:
    """Where a calibration comes from: head, moment, person, software, and how warm it was; figures that were found.

    `origin` is "imported" for a PSF that others measured, and `source` says where; `unknown` names what nobody knows
    of it, by the names of `Calibration` and `Sensor`. What stands there instead is a value that means nothing.
    `meter` is what the LEDs were measured with, and when.
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
class Kept:
    """A calibration, and where it comes from."""

    calibration: Calibration
    provenance: Provenance


class Archive:
    """The calibrations under one folder, which is made when the first is kept."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def keep(self, calibration: Calibration, provenance: Provenance) -> str:
        """Write it to the disk whole, put it in force, and return its id; keeping the same one twice is harmless."""
        id = self.add(calibration, provenance)
        self.use(id)
        return id

    def add(self, calibration: Calibration, provenance: Provenance) -> str:
        """The same without putting it in force."""
        return self.adopt(_files(calibration, provenance))

    def adopt(self, files: Mapping[str, bytes]) -> str:
        """Keep the files of a calibration as they are, without putting it in force, and return its id.

        They are checked first, as `load` does; one that is here already, whole, stays as it is. A power cut leaves the
        archive as it was, or with it.
        """
        id = kept_elsewhere(files).calibration.id
        with self._alone():
            for left in self.root.glob(".part*"):  # by a power cut
                shutil.rmtree(left)
            place = self.root / id
            if not self._is_whole(id):
                shutil.rmtree(place, ignore_errors=True)
                part = Path(tempfile.mkdtemp(prefix=".part", dir=self.root))
                try:
                    for name, content in files.items():
                        write_synced(part / name, content)
                    sync_folder(part)
                    part.rename(place)
                except BaseException:
                    shutil.rmtree(part, ignore_errors=True)
                    raise
                sync_folder(self.root)
        return id

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Wait until no other process changes the archive; a killed one gives its place up. StoreError if none may."""
        try:
            _make_folder(self.root)
            with (self.root / ".lock").open("ab") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield
        except OSError as error:
            full = StoreFull if error.errno in (errno.ENOSPC, errno.EDQUOT) else StoreError
            raise full(
                f"{self.root} cannot be written: {error.strerror or error}",
                "Make room there or choose another folder; the calibrations that were kept are as before.",
            ) from error

    def use(self, id: str) -> None:
        """Put a kept calibration in force; it is read and checked first."""
        self.load(id)
        with self._alone():
            part = self.root / f".{CURRENT}"
            write_synced(part, id.encode("ascii"))
            part.rename(self.root / CURRENT)
            sync_folder(self.root)

    def load(self, id: str | None = None) -> Kept:
        """The one in force, or the one of that name; CalibrationMissing, or CalibrationDamaged at one wrong byte."""
        id = id or self.current()
        return _read(_content(self._place(id)), id)

    def files(self, id: str) -> dict[str, bytes]:
        """The files of a calibration exactly as they are kept; they have been checked."""
        found = _content(self._place(id))
        _read(found, id)
        return {name: found[name] for name in (MANIFEST, *_said(found)["sha256"])}

    def _place(self, id: str) -> Path:
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

    def current(self) -> str:
        """The id in force."""
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
        """All that are kept, damaged ones too, the oldest first."""
        if not self.root.is_dir():
            return ()
        found = [place for place in self.root.iterdir() if ID.fullmatch(place.name) and place.is_dir()]
        return tuple(place.name for place in sorted(found, key=lambda place: place.stat().st_mtime_ns))


def _files(calibration: Calibration, provenance: Provenance) -> dict[str, bytes]:
    arrays = {f"psf{k}.npy": psf.pixels for k, psf in enumerate(calibration.psfs)}
    arrays |= {f"{name}.npy": array for name in MAPS if (array := getattr(calibration, name)) is not None}
    found = {name: _npy(array) for name, array in arrays.items()}
    found[MANIFEST] = _sealed(_toml(_manifest(calibration, provenance, found)))
    return found


def kept_elsewhere(files: Mapping[str, bytes]) -> Kept:
    """What is in files that were not kept here; CalibrationDamaged unless they are all of one calibration, and whole.

    Nothing that they name is looked for in any folder.
    """
    try:
        said = _said(files)
        id, names = str(said["id"]), {MANIFEST, *said["sha256"]}
    except _BROKEN as error:
        raise CalibrationDamaged(f"this is not a whole calibration: {error}") from error
    if set(files) != names or not all(NAME.fullmatch(name) for name in names):
        raise CalibrationDamaged("this calibration holds other files than its manifest names")
    return _read(files, id)


def _manifest(calibration: Calibration, provenance: Provenance, arrays: dict[str, bytes]) -> dict[str, Any]:
    said = asdict(provenance) | {"made_at": provenance.made_at.isoformat(), "figures": None}
    said["unknown"] = list(provenance.unknown)
    return {
        "format": FORMAT, "id": calibration.id, "simulated": calibration.simulated, "field_deg": calibration.field_deg,
        "psf_names": [psf.name for psf in calibration.psfs],
        "psf_colours": [psf.colour or "every" for psf in calibration.psfs],
        "sensor": asdict(calibration.sensor),
        "geometry": asdict(calibration.geometry) if calibration.geometry else None,
        "provenance": said, "figures": dict(provenance.figures),
        "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in arrays.items()},
    }  # fmt: skip


def _content(place: Path) -> dict[str, bytes]:
    try:
        return {path.name: path.read_bytes() for path in sorted(place.iterdir()) if path.is_file()}
    except OSError as error:
        raise CalibrationDamaged(f"calibration {place.name} cannot be read: {error.strerror}") from error


def _said(files: Mapping[str, bytes]) -> dict[str, Any]:
    said = tomllib.loads(_unsealed(_named(files, MANIFEST)))
    if said["format"] != FORMAT:
        raise CalibrationFormat(f"this calibration was kept in format {said['format']}; known here is {FORMAT}")
    return said


def _named(files: Mapping[str, bytes], name: str) -> bytes:
    if name not in files:
        raise ValueError(f"{name} is missing")
    return files[name]


def _read(files: Mapping[str, bytes], id: str) -> Kept:
    try:
        said = _said(files)
        arrays = {name: _array(_named(files, name), digest) for name, digest in said["sha256"].items()}
        calibration = Calibration(
            psfs=tuple(
                Psf(arrays[f"psf{k}.npy"], str(name), None if colour == "every" else _COLOUR.validate_python(colour))
                for k, (name, colour) in enumerate(zip(said["psf_names"], said["psf_colours"], strict=True))
            ),
            sensor=Sensor(**_numbers(said["sensor"])),
            geometry=Geometry(**_numbers(said["geometry"])) if "geometry" in said else None,
            field_deg=_numbers({"field_deg": said.get("field_deg")})["field_deg"],
            simulated=_TRUTH.validate_python(said["simulated"]),
            **{name: _map(arrays.get(f"{name}.npy"), name) for name in MAPS},
        )
        figures = tuple(said["figures"].items())
        whose = _WHOSE.validate_python(said["provenance"] | {"figures": figures})
        kept = Kept(calibration, whose)
    except _BROKEN as error:
        raise CalibrationDamaged(f"calibration {id}: {error}") from error
    if kept.calibration.id != id:
        raise CalibrationDamaged(f"calibration {id} holds {kept.calibration.id}")
    return kept


_TRUTH, _NUMBERS, _WHOSE = TypeAdapter(bool), TypeAdapter(dict[str, float | None]), TypeAdapter(Provenance)
_COLOUR: TypeAdapter[Colour] = TypeAdapter(Colour)
_BROKEN = (ValueError, LookupError, TypeError, AttributeError, EOFError, MemoryError, RecursionError)


def _numbers(table: dict[str, Any]) -> dict[str, Any]:
    """The same table, or ValueError if it holds anything but numbers; their digits are part of the id."""
    _NUMBERS.validate_python(table, strict=True)
    return table


def _map(array: np.ndarray | None, name: str) -> np.ndarray | None:
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


def _toml(table: dict[str, Any]) -> str:
    """A flat table with tables in it, as TOML; None is left out."""
    lines = [
        f"{key} = {_plain(value)}" for key, value in table.items() if value is not None and type(value) is not dict
    ]
    for name, inner in table.items():
        if type(inner) is dict:
            lines += ["", f"[{name}]"]
            lines += [f"{json.dumps(key)} = {_plain(value)}" for key, value in inner.items() if value is not None]
    return "\n".join(lines) + "\n"


def _plain(value: Any) -> str:
    return json.dumps(value, ensure_ascii=True) if isinstance(value, bool | str | list) else repr(value)


def _sealed(text: str) -> bytes:
    body = text.encode("utf-8")
    return f'seal = "{hashlib.sha256(body).hexdigest()}"\n'.encode("ascii") + body


def _unsealed(content: bytes) -> str:
    head, _, body = content.partition(b"\n")
    if head != f'seal = "{hashlib.sha256(body).hexdigest()}"'.encode("ascii"):
        raise ValueError("the manifest is not what was kept")
    return body.decode("utf-8")


def write_synced(path: Path, content: bytes) -> None:
    """Write a file, and return when it is on the disk."""
    with path.open("wb") as out:
        out.write(content)
        out.flush()
        os.fsync(out.fileno())


def _make_folder(folder: Path) -> None:
    """Make a folder, with those above it; their names are on the disk too, or a power cut takes all that is inside."""
    if not folder.is_dir():
        _make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Return when the names in a folder are on the disk."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
