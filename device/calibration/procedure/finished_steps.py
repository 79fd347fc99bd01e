"""Checkpoints of finished calibration steps: one file each, reused for 12 h, for example after a power cut."""

import io
import shutil
from dataclasses import fields
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from device import atomic_io
from device.calibration.procedure.darks import Darks
from device.calibration.procedure.flats import Flats
from device.calibration.procedure.point_source import PointSource
from device.clock import Clock

CHECKPOINT_LIFETIME = timedelta(hours=12)
Step = TypeVar("Step", Darks, Flats, PointSource)


class StepCheckpoints:
    """Checkpoint files of one head in one folder; files of another head, older than 12 h, or damaged are ignored.

    `simulated` is whether any step was simulated; the flag is stored with each checkpoint and restored on load.
    """

    def __init__(self, folder: Path, key: str, clock: Clock) -> None:
        self.folder, self.key, self.clock = folder, key, clock
        self.simulated = False

    def save(self, name: str, measured: Darks | Flats | PointSource) -> None:
        """Write a checkpoint atomically (write, fsync, rename)."""
        out = io.BytesIO()
        made_at = self.clock.wall().isoformat()
        np.savez(out, whose=self.key, made_at=made_at, simulated=self.simulated, **vars(measured))
        atomic_io.make_folder(self.folder)
        atomic_io.write_atomically(self._path(name), out.getvalue())

    def load(self, name: str, kind: type[Step]) -> Step | None:
        """Return the stored step if its file is whole, of this head and younger than 12 h; else None."""
        try:
            with np.load(io.BytesIO(self._path(name).read_bytes()), allow_pickle=False) as held:
                age = self.clock.wall() - datetime.fromisoformat(held["made_at"].item())
                if held["whose"].item() != self.key or not timedelta(0) <= age < CHECKPOINT_LIFETIME:
                    return None
                found = kind(**{field.name: _field_value(held[field.name]) for field in fields(kind)})
                self.simulated |= held["simulated"].item()
                return found
        except (OSError, ValueError, KeyError, EOFError, BadZipFile):
            return None  # missing or damaged: the step is measured again

    def discard(self, *names: str) -> None:
        """Delete these checkpoints, so that the steps are measured again."""
        for name in names:
            self._path(name).unlink(missing_ok=True)

    def clear(self) -> None:
        """Delete the folder with all checkpoints, after the calibration is stored."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def _field_value(value: np.ndarray) -> Any:
    """Return a stored array as the field value it was: a number, a tuple, or a map."""
    return value.item() if value.ndim == 0 else tuple(value.tolist()) if value.ndim == 1 else value
