"""Peers for comparison: LenslessPiCam's ADMM, run in a process of its own Python environment.

LenslessPiCam (Bezzam et al. 2023, AGPL-3) is no dependency: it has other versions of numpy and another licence. Its
environment is made by `make bench-peers`, or by hand (page on data sets).
"""

import json
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

import numpy as np

from device.errors import SettingError
from device.recon.model.kernels import Pixels
from device.values import Image

ENVIRONMENT = Path(".bench-venv")
SCRIPT = Path(__file__).with_name("lensless_peer.py")
REMEDY = "Install it again with `make bench-peers`, or leave it out with --no-peers."


@dataclass(frozen=True)
class PeerPicture:
    """Picture of a peer: name with version and rounds, time of the solver in s, peak memory in MB (None: not asked)."""

    name: str
    seconds: float
    peak_mb: float | None
    picture: Image


class LenslessPeer:
    """LenslessPiCam's ADMM in one process for many frames; a context manager, which ends the process.

    `environment` is the folder of its virtual environment, `rounds` the numbers of rounds, one picture each. The
    process starts with the first frame, and again after a failure.
    """

    def __init__(self, environment: Path, rounds: Sequence[int], memory: bool = False) -> None:
        self.python = environment / "bin" / "python"
        self.rounds = tuple(rounds)
        self.memory = memory
        self._process: subprocess.Popen[str] | None = None
        self._temporary = TemporaryDirectory()
        self._folder = Path(self._temporary.name)

    @property
    def is_installed(self) -> bool:
        """Whether the environment exists."""
        return self.python.exists()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
        self._temporary.cleanup()

    def __call__(self, counts: Pixels, psf: Image) -> tuple[PeerPicture, ...]:
        """Return one picture per number of rounds; `counts` (rows, cols) or (rows, cols, 3), `psf` (rows, cols).

        SettingError if the process fails, with the last line of its output.
        """
        np.savez(self._folder / "in.npz", y=counts, psf=psf, rounds=np.array(self.rounds), memory=self.memory)
        return tuple(
            PeerPicture(
                f"LenslessPiCam {run['version']} ADMM, {run['rounds']} rounds",
                run["ms"] / 1e3,
                run["mb"],
                np.load(self._folder / f"{k}.npy"),
            )
            for k, run in enumerate(json.loads(self._answer()))
        )

    def _answer(self) -> str:
        """Send one line to the process and return its answer; SettingError if it ends without one."""
        if self._process is None:
            self._process = self._start()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write("\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._stop()
            last = (self._log.read_text(encoding="utf-8", errors="replace").splitlines() or ["no message"])[-1]
            raise SettingError(f"LenslessPiCam ended with: {last}", REMEDY)
        return answer

    def _start(self) -> subprocess.Popen[str]:
        if not self.is_installed:
            raise SettingError(f"LenslessPiCam is not installed: there is no {self.python}", REMEDY)
        with self._log.open("w", encoding="utf-8") as log:
            command = [str(self.python), "-I", str(SCRIPT), self._temporary.name]
            pipe = subprocess.PIPE
            return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=log, text=True)

    @property
    def _log(self) -> Path:
        return self._folder / "stderr"

    def _stop(self) -> None:
        """End the process, if it runs, and wait for it."""
        process = self._process
        self._process = None
        if process is None:
            return
        process.kill()
        process.communicate()


@contextmanager
def installed_peer(
    environment: Path | None, rounds: Sequence[int], progress: Callable[[str], None]
) -> Iterator[LenslessPeer | None]:
    """Yield the peer of an environment, None if it is not wanted, or not installed (with one line of `progress`)."""
    if environment is None:
        yield None
        return
    with LenslessPeer(environment, rounds) as peer:
        if not peer.is_installed:
            progress(f"LenslessPiCam is left out: there is no {environment}; make bench-peers installs it")
        yield peer if peer.is_installed else None
