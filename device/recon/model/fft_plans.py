"""Planned real FFTs (FFTW): one plan per shape, bound to its arrays, with FFTW's wisdom (measured plans) kept on disk.

Planning happens at construction, before the first capture; a capture only executes plans.
"""

import hashlib
import json
import logging
import platform
from pathlib import Path
from threading import Lock

import numpy as np
import pyfftw
from numpy.typing import NDArray

from device import atomic_io
from device.errors import SettingError
from device.values import Image

log = logging.getLogger(__name__)

Spectrum = NDArray[np.complex64]


class RealFft:
    """Forward and inverse real FFT of one shape, with two arrays of its own.

    `space` is float32 (rows, cols), `spectrum` complex64 (rows, cols//2 + 1). Neither direction normalises: include
    1/(rows*cols) in a filter. The inverse overwrites the spectrum. Planning erases both arrays.
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
        """Return the unnormalised spectrum of `space` (the array `spectrum` itself); `space` is overwritten."""
        self._forward.execute()
        return self.spectrum

    def inverse(self) -> Image:
        """Return the image of `spectrum`, times rows*cols (the array `space` itself); `spectrum` is overwritten."""
        self._inverse.execute()
        return self.space

    @staticmethod
    def memory_bytes(shape: tuple[int, int]) -> int:
        """Return the bytes of the two arrays of one plan."""
        rows, cols = shape
        return 4 * rows * cols + 8 * rows * (cols // 2 + 1)


class Planner:
    """Factory of FFT plans that keeps FFTW's wisdom in a folder, so that the next start does not measure again.

    One thread by default: two save a fifth of a full-size forward and inverse FFT on an idle machine, and
    double its duration (small grids: ten times) while another process occupies the second core. The slowest
    capture matters, not the mean.

    Wisdom is valid for one processor and one build of FFTW; the file name is a hash of both. Several
    threads may plan at once.

    Parameters
    ----------
    folder
        Folder of the wisdom; None keeps none.
    threads
        Threads of each FFT, from 1.
    effort
        Planner flag of FFTW.

    Raises
    ------
    SettingError
        Fewer than one thread.
    """

    def __init__(self, folder: Path | None, threads: int = 1, effort: str = "FFTW_MEASURE") -> None:
        if threads < 1:
            raise SettingError(f"{threads} threads cannot plan anything")
        self.threads, self.effort, self.folder = threads, effort, folder
        self.planned = 0
        self._lock = Lock()
        if folder is not None:
            self._import_wisdom(self._file(folder))

    @staticmethod
    def _file(folder: Path) -> Path:
        machine = f"{platform.machine()} {processor_name()} {pyfftw.__version__} {pyfftw.fftw_version}"
        return folder / f"fftw-{hashlib.sha256(machine.encode()).hexdigest()[:12]}.wisdom"

    @staticmethod
    def _import_wisdom(file: Path) -> None:
        try:
            wisdom = [text.encode("ascii") for text in json.loads(file.read_text(encoding="ascii"))]
        except FileNotFoundError:
            return
        except (OSError, ValueError, AttributeError) as error:  # a damaged cache file costs seconds of planning only
            log.warning("%s cannot be used (%s): planning the FFTs again", file, error)
            return
        pyfftw.import_wisdom(tuple(wisdom))

    @staticmethod
    def _write_wisdom(wisdom: tuple[bytes, ...], file: Path) -> None:
        content = json.dumps([text.decode("ascii") for text in wisdom]).encode("ascii")
        try:
            atomic_io.make_folder(file.parent)
            atomic_io.write_atomically(file, content)
        except OSError as error:
            log.warning("cannot write FFT wisdom to %s (%s): the next start plans again", file.parent, error)

    def plan(self, shape: tuple[int, int]) -> RealFft:
        """Return a new plan for one shape, and write new wisdom to the folder.

        A failure to write it is only logged.

        Parameters
        ----------
        shape
            (rows, cols) of the image.

        Returns
        -------
        RealFft
            Plan with arrays of its own.
        """
        with self._lock:
            known = pyfftw.export_wisdom()
            fft = RealFft(shape, self.threads, self.effort)
            self.planned += 1
            wisdom = pyfftw.export_wisdom()
            if self.folder is not None and wisdom != known:
                self._write_wisdom(wisdom, self._file(self.folder))
            return fft


def processor_name() -> str:
    """Return the name of the processor from /proc/cpuinfo, else from `platform`; empty if unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(("model name", "Model"))), "")
