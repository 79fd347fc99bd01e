"""Optional recording of every raw frame of a calibration beside the calibration.

FOLDER/<step>/00001_0.1s.npy    uint16 counts (rows, cols), and in NAME.json whether it is simulated
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

from device import atomic_io
from device.config.marked_files import write_side_file
from device.values import Frame

SUMS = "SHA256SUMS"
RESERVE_BYTES = 300_000_000  # a calibration of two megapixels and its steps take 100 MB


class RawRecorder:
    """Recorder of raw frames; a write error or full disk ends the recording with a message, the calibration continues.

    `reserve_bytes` of the disk are left free for the calibration.
    """

    def __init__(self, folder: Path, show_message: Callable[[str], None], reserve_bytes: int = RESERVE_BYTES) -> None:
        self.folder, self.show_message, self.reserve_bytes = folder, show_message, reserve_bytes
        self.frame_count = 0
        self.failed = False
        self._step = folder

    def begin_step(self, step: str) -> None:
        """Start recording a step, and delete earlier frames of that step."""
        self._step = self.folder / step
        self.frame_count = 0
        shutil.rmtree(self._step, ignore_errors=True)

    def record(self, frame: Frame) -> None:
        """Write one frame and its SHA-256; after a failed write show a message and record nothing more."""
        if self.failed:
            return
        path = self._step / f"{self.frame_count + 1:05d}_{frame.exposure_s:.6g}s.npy"
        out = io.BytesIO()
        np.save(out, frame.counts, allow_pickle=False)
        content = out.getvalue()
        try:
            atomic_io.make_folder(self._step)
            if not atomic_io.has_room(len(content), atomic_io.free_bytes(self._step), self.reserve_bytes):
                raise OSError(errno.ENOSPC, f"less than {self.reserve_bytes / 1e6:.0f} MB are left")
            with open(path, "wb", opener=atomic_io.private_opener) as file:
                file.write(content)
            write_side_file(path, frame.simulated, atomic_io.private_opener)
            with open(self._step / SUMS, "a", encoding="ascii", opener=atomic_io.private_opener) as sums:
                sums.write(f"{hashlib.sha256(content).hexdigest()}  {path.name}\n")
        except OSError as error:
            self.failed = True
            with suppress(OSError):  # remove a partial frame
                path.unlink()
            self.show_message(
                f"raw frames are not kept any more: frame {self.frame_count + 1} "
                f"of {self._step.name} cannot be written "
                f"({error.strerror or error}). The calibration goes on. Make room, then calibrate again to have them."
            )
            return
        self.frame_count += 1

    def finish(self, beside: Path) -> None:
        """Move the recorded frames to the folder `beside`, next to the finished calibration; replaces that folder."""
        if self.folder.is_dir():
            shutil.rmtree(beside, ignore_errors=True)
            atomic_io.replace_durably(self.folder, beside)
