"""Where calibrations are kept: one folder for each, named by its content, whole or not there, every byte checked.

    ROOT/<id>/manifest.toml     a seal over the rest of it, the numbers, who and when, and the SHA-256 of each array
    ROOT/<id>/psf0.npy ...      the arrays
    ROOT/current                the id that is in force

A calibration is never changed. A new one is written beside the old ones and takes effect by one rename; to go back is
the same rename. A power cut at any moment leaves the old one in force, or the new one, whole.
"""

import hashlib
import io
import json
import os
import shutil
import tempfile
import tomllib
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from device.errors import CalibrationDamaged, CalibrationError, CalibrationMissing
from device.values import Calibration, Geometry, Psf, Sensor

MANIFEST, CURRENT = "manifest.toml", "current"
MAPS = ("dark_dn", "flat", "bad")
FORMAT = 1


@dataclass(frozen=True)
class Provenance:
    """Where a calibration comes from: head, moment, person, software, and how warm it was; figures that were found.

    `meter` is what the LEDs were measured with, and when.
    """

    serial: str
    made_at: datetime
    made_by: str
    software: str
    temperature_c: float | None = None
    figures: tuple[tuple[str, float], ...] = ()
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
        self.root.mkdir(parents=True, exist_ok=True)
        for left in self.root.glob(".part*"):  # by a power cut
            shutil.rmtree(left)
        place = self.root / calibration.id
        if not self._is_whole(calibration.id):
            shutil.rmtree(place, ignore_errors=True)
            part = Path(tempfile.mkdtemp(prefix=".part", dir=self.root))
            try:
                for name, content in _files(calibration, provenance).items():
                    write_synced(part / name, content)
                sync_folder(part)
                part.rename(place)
            except BaseException:
                shutil.rmtree(part, ignore_errors=True)
                raise
            sync_folder(self.root)
        self.use(calibration.id)
        return calibration.id

    def use(self, id: str) -> None:
        """Put a kept calibration in force; it is read and checked first."""
        self.load(id)
        part = self.root / f".{CURRENT}"
        write_synced(part, id.encode("ascii"))
        part.rename(self.root / CURRENT)
        sync_folder(self.root)

    def load(self, id: str | None = None) -> Kept:
        """The one in force, or the one of that name; CalibrationMissing, or CalibrationDamaged at one wrong byte."""
        id = id or self.current()
        place = self.root / id
        if not (place / MANIFEST).is_file():
            raise CalibrationMissing(f"there is no calibration {id} in {self.root}")
        return _read(place, id)

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
            raise CalibrationMissing(f"no calibration is in force in {self.root}")
        id = path.read_bytes().decode("ascii", "replace")
        if len(id) != 16 or not all(digit in "0123456789abcdef" for digit in id):
            raise CalibrationDamaged(f"{path} does not hold the name of a calibration")
        return id

    def ids(self) -> tuple[str, ...]:
        """All that are kept, the oldest first."""
        if not self.root.is_dir():
            return ()
        found = [place for place in self.root.iterdir() if (place / MANIFEST).is_file() and place.name[0] != "."]
        return tuple(place.name for place in sorted(found, key=lambda place: (place / MANIFEST).stat().st_mtime_ns))


def _files(calibration: Calibration, provenance: Provenance) -> dict[str, bytes]:
    arrays = {f"psf{k}.npy": psf.pixels for k, psf in enumerate(calibration.psfs)}
    arrays |= {f"{name}.npy": array for name in MAPS if (array := getattr(calibration, name)) is not None}
    found = {name: _npy(array) for name, array in arrays.items()}
    found[MANIFEST] = _sealed(_toml(_manifest(calibration, provenance, found)))
    return found


def _manifest(calibration: Calibration, provenance: Provenance, arrays: dict[str, bytes]) -> dict[str, Any]:
    said = asdict(provenance) | {"made_at": provenance.made_at.isoformat(), "figures": None}
    return {
        "format": FORMAT, "id": calibration.id, "simulated": calibration.simulated, "field_deg": calibration.field_deg,
        "psf_names": [psf.name for psf in calibration.psfs],
        "psf_colours": [psf.colour or "every" for psf in calibration.psfs],
        "sensor": asdict(calibration.sensor),
        "geometry": asdict(calibration.geometry) if calibration.geometry else None,
        "provenance": said, "figures": dict(provenance.figures),
        "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in arrays.items()},
    }  # fmt: skip


def _read(place: Path, id: str) -> Kept:
    try:
        said = tomllib.loads(_unsealed((place / MANIFEST).read_bytes()))
        arrays = {name: _array((place / name).read_bytes(), digest) for name, digest in said["sha256"].items()}
        calibration = Calibration(
            psfs=tuple(
                Psf(arrays[f"psf{k}.npy"], name, None if colour == "every" else colour)
                for k, (name, colour) in enumerate(zip(said["psf_names"], said["psf_colours"], strict=True))
            ),
            sensor=Sensor(**said["sensor"]),
            geometry=Geometry(**said["geometry"]) if "geometry" in said else None,
            field_deg=said.get("field_deg"),
            simulated=said["simulated"],
            **{name: arrays.get(f"{name}.npy") for name in MAPS},
        )
        whose = said["provenance"] | {"made_at": datetime.fromisoformat(said["provenance"]["made_at"])}
        figures = tuple(said["figures"].items())
        kept = Kept(calibration, Provenance(**{key: whose.get(key) for key in _NAMES if key in whose}, figures=figures))
    except (OSError, ValueError, KeyError, TypeError, EOFError) as error:
        raise CalibrationDamaged(f"calibration {id}: {error}") from error
    if kept.calibration.id != id:
        raise CalibrationDamaged(f"calibration {id} holds {kept.calibration.id}")
    return kept


_NAMES = tuple(field.name for field in fields(Provenance) if field.name != "figures")


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


def sync_folder(folder: Path) -> None:
    """Return when the names in a folder are on the disk."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
