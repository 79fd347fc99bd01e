"""Steps of a calibration that are done: each in a file of its own, taken up again for half a day after a power cut."""

import io
import shutil
from dataclasses import fields
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from device.calibration.archive import sync_folder, write_synced
from device.calibration.darks import Darks
from device.calibration.flats import Flats
from device.calibration.point import Point
from device.clock import Clock

KEPT_FOR = timedelta(hours=12)
Step = TypeVar("Step", Darks, Flats, Point)


class Steps:
    """The files of one head's steps in one folder; those of another head, of yesterday, or damaged are not there.

    `simulated` is whether any of them was: it must not get lost where all of them are taken up again.
    """

    def __init__(self, folder: Path, whose: str, clock: Clock) -> None:
        self.folder, self.whose, self.clock = folder, whose, clock
        self.simulated = False

    def keep(self, name: str, measured: Darks | Flats | Point) -> None:
        """Write a step; it is on the disk when this returns."""
        out = io.BytesIO()
        made_at = self.clock.wall().isoformat()
        np.savez(out, whose=self.whose, made_at=made_at, simulated=self.simulated, **vars(measured))
        self.folder.mkdir(parents=True, exist_ok=True)
        part = self.folder / f".{name}"
        write_synced(part, out.getvalue())
        part.replace(self._path(name))
        sync_folder(self.folder)

    def taken_up(self, name: str, kind: type[Step]) -> Step | None:
        """What was measured before, if it is of this head and of today."""
        try:
            with np.load(io.BytesIO(self._path(name).read_bytes()), allow_pickle=False) as held:
                age = self.clock.wall() - datetime.fromisoformat(held["made_at"].item())
                if held["whose"].item() != self.whose or not timedelta(0) <= age < KEPT_FOR:
                    return None
                found = kind(**{field.name: _plain(held[field.name]) for field in fields(kind)})
                self.simulated |= held["simulated"].item()
                return found
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            return None  # not there, or damaged: it is measured again

    def forget(self, *names: str) -> None:
        """These must be measured again."""
        for name in names:
            self._path(name).unlink(missing_ok=True)

    def clear(self) -> None:
        """The calibration is kept; its steps are not needed any more."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def _plain(value: np.ndarray) -> Any:
    """A number, a pair, or a map, as it was before it was kept."""
    return value.item() if value.ndim == 0 else tuple(value.tolist()) if value.ndim == 1 else value
