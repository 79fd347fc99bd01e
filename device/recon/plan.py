"""Planned real FFTs: made once per shape, bound to their arrays, remembered on disk, never made on a press."""

import hashlib
import json
import logging
import platform
from pathlib import Path

import numpy as np
import pyfftw
from numpy.typing import NDArray

from device.errors import SettingError
from device.values import Image

log = logging.getLogger(__name__)

Spectrum = NDArray[np.complex64]


class RealFft:
    """A forward and an inverse real FFT of one shape over two arrays of their own.

    `space` is float32 (rows, cols), `spectrum` complex64 (rows, cols//2 + 1). Neither direction normalises: fold
    1/(rows*cols) into a filter. The inverse spoils the spectrum. Planning erases both arrays.
    """

    def __init__(self, shape: tuple[int, int], threads: int, effort: str) -> None:
        rows, cols = shape
        self.shape = shape
        self.space: Image = pyfftw.zeros_aligned(shape, np.float32)
        self.spectrum: Spectrum = pyfftw.zeros_aligned((rows, cols // 2 + 1), np.complex64)
        flags = (effort, "FFTW_DESTROY_INPUT")
        self._forward = pyfftw.FFTW(self.space, self.spectrum, axes=(0, 1), threads=threads, flags=flags)
        self._inverse = pyfftw.FFTW(
            self.spectrum, self.space, axes=(0, 1), direction="FFTW_BACKWARD", threads=threads, flags=flags
        )
        self.space[:] = 0
        self.spectrum[:] = 0

    def forward(self) -> Spectrum:
        """The spectrum of what is in `space`; `space` is spoilt."""
        self._forward.execute()
        return self.spectrum

    def inverse(self) -> Image:
        """The image of what is in `spectrum`, times rows*cols; `spectrum` is spoilt."""
        self._inverse.execute()
        return self.space

    @staticmethod
    def memory_bytes(shape: tuple[int, int]) -> int:
        """What the two arrays of one plan take."""
        rows, cols = shape
        return 4 * rows * cols + 8 * rows * (cols // 2 + 1)


class Planner:
    """Makes plans, and keeps FFTW's wisdom in a folder so that the next start need not measure again.

    One thread by default: two save a fifth of a full-size pair on an idle machine, and cost it double (small grids: ten
    times) when a neighbour holds the other core. The slowest press counts, not the mean.

    Wisdom belongs to one processor and one build of FFTW: the file's name says which.
    """

    def __init__(self, folder: Path | None, threads: int = 1, effort: str = "FFTW_MEASURE") -> None:
        if threads < 1:
            raise SettingError(f"{threads} threads cannot plan anything")
        self.threads, self.effort, self.folder = threads, effort, folder
        self.planned = 0
        if folder is not None and (file := self._file(folder)).is_file():
            self._remember(file)

    @staticmethod
    def _file(folder: Path) -> Path:
        machine = f"{platform.machine()} {processor()} {pyfftw.__version__} {pyfftw.fftw_version}"
        return folder / f"fftw-{hashlib.sha256(machine.encode()).hexdigest()[:12]}.wisdom"

    @staticmethod
    def _remember(file: Path) -> None:
        try:
            wisdom = [text.encode("ascii") for text in json.loads(file.read_text(encoding="ascii"))]
        except (ValueError, AttributeError) as error:  # a damaged cache costs seconds, never a picture
            log.warning("%s is damaged (%s): plans are made again", file, error)
            return
        pyfftw.import_wisdom(tuple(wisdom))

    @staticmethod
    def _keep(wisdom: tuple[bytes, ...], file: Path) -> None:
        part = file.with_suffix(".part")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(json.dumps([text.decode("ascii") for text in wisdom]), encoding="ascii")
            part.replace(file)
        except OSError as error:
            log.warning("the plans cannot be kept in %s (%s): the next start makes them again", file.parent, error)

    def plan(self, shape: tuple[int, int]) -> RealFft:
        """A plan for one shape; its wisdom is kept if there is a folder."""
        known = pyfftw.export_wisdom()
        fft = RealFft(shape, self.threads, self.effort)
        self.planned += 1
        wisdom = pyfftw.export_wisdom()
        if self.folder is not None and wisdom != known:
            self._keep(wisdom, self._file(self.folder))
        return fft


def processor() -> str:
    """What the computer calls its processor; empty where it does not say."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(("model name", "Model"))), "")
