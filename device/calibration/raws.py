"""Every raw frame of a calibration, if somebody wants them: written as they come, beside the calibration.

FOLDER/<step>/00001_0.1s.npy    uint16 counts (rows, cols)
FOLDER/<step>/SHA256SUMS        for `sha256sum --check`
"""

import errno
import hashlib
import io
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from device.values import Frame

SUMS = "SHA256SUMS"
RESERVE_BYTES = 300_000_000  # a calibration of two megapixels and its steps take 100 MB


class Raws:
    """A folder for raw frames. A full disk ends the keeping, in words, and never the calibration.

    `reserve_bytes` of the disk are left for that.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None], reserve_bytes: int = RESERVE_BYTES) -> None:
        self.folder, self.tell, self.reserve_bytes = folder, tell, reserve_bytes
        self.kept, self.failed = 0, False
        self._step = folder

    def begin(self, step: str) -> None:
        """The frames from now on belong to this step, which is measured anew."""
        self._step = self.folder / step
        self.kept = 0
        shutil.rmtree(self._step, ignore_errors=True)

    def keep(self, frame: Frame) -> None:
        """Write one frame and its digest."""
        if self.failed:
            return
        path = self._step / f"{self.kept + 1:05d}_{frame.exposure_s:.6g}s.npy"
        out = io.BytesIO()
        np.save(out, frame.counts, allow_pickle=False)
        content = out.getvalue()
        try:
            self._step.mkdir(parents=True, exist_ok=True)
            if shutil.disk_usage(self._step).free < self.reserve_bytes + len(content):
                raise OSError(errno.ENOSPC, f"less than {self.reserve_bytes / 1e6:.0f} MB are left")
            path.write_bytes(content)
            with (self._step / SUMS).open("a", encoding="ascii") as sums:
                sums.write(f"{hashlib.sha256(content).hexdigest()}  {path.name}\n")
        except OSError as error:
            self.failed = True
            with suppress(OSError):  # half a frame, if it came to that
                path.unlink()
            self.tell(
                f"raw frames are not kept any more: frame {self.kept + 1} of {self._step.name} cannot be written "
                f"({error.strerror or error}). The calibration goes on. Make room, then calibrate again to have them."
            )
            return
        self.kept += 1

    def finish(self, beside: Path) -> None:
        """All is done: they lie beside what was made of them."""
        if self.folder.is_dir():
            shutil.rmtree(beside, ignore_errors=True)
            self.folder.rename(beside)
