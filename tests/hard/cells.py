"""Columns of the grid: each hard frame, reconstructed with every method and with the default schedule.

A frame is written as the files that a user provides (raw, PSF, head file, flat frame) and read by the functions of
`diffuscope reconstruct`. Reconstructors are cached by the content of all files except the raw; the command plans on
every call.
"""

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from device.errors import DiffuscopeError
from device.recon.assessment.metrics import pcc
from device.recon.methods import METHODS
from device.recon.model.fft_plans import Planner
from device.values import Image, Mask, Reconstruction, Report
from services.research.benchmark import without_bad_pixels
from services.research.peers import LenslessPeer
from services.research.reconstruct_file import FileReconstructor
from services.research.reconstruct_inputs import ReconstructOptions, load_raw
from tests.hard.cases import CLEAN, Case
from tests.hard.frames import Eye, HardFrame, head_toml

DEFAULT_SCHEDULE = "ladder"  # the default schedule: quick look, refraction, iterations
COLUMNS = (DEFAULT_SCHEDULE, *METHODS)
PEER, PEER_ROUNDS = "LenslessPiCam", 10  # its ADMM, twice the rounds of its own settings; it gives no messages
LONG_DEADLINE_S = 600.0  # of the command: it stops no solver, so the grid has none
CRASHES = (ArithmeticError, ValueError, LookupError, TypeError)  # program errors, reported as `Cell.crashed`
CACHE_SIZE = 8  # cached reconstructors; each plan of one takes up to about 300 MB at full sensor size


@dataclass(frozen=True)
class Cell:
    """The result of one method on one frame.

    `pcc` (-1 to 1) is the correlation with the truth inside the lit field, `lost` the clean picture's `pcc` of the same
    method minus it. Both are None if the frame was refused with the message `refused`, or if the solver `crashed` with
    the exception text `refused`. `warnings` are the messages with the picture, `quality` its quality figures.
    `sphere_dpt` with `sd_dpt` is the estimated, `true_dpt` the true spectacle correction (negative: myopia), relative
    to the eye of the PSF: minus `Refraction.m_dpt`. None: not estimated, or undefined for the frame.
    """

    eye: str
    case: str
    method: str
    pcc: float | None
    lost: float | None
    refused: str
    warnings: tuple[str, ...]
    sphere_dpt: float | None
    sd_dpt: float | None
    true_dpt: float | None
    quality: dict[str, float | None]
    crashed: bool = False

    @property
    def off_sd(self) -> float | None:
        """Refraction error in its own standard deviations; None without an estimate or a true value."""
        if self.sphere_dpt is None or self.sd_dpt is None or self.true_dpt is None:
            return None
        return (self.sphere_dpt - self.true_dpt) / max(self.sd_dpt, 1e-9)


class SolverCache:
    """Least-recently-used cache of file reconstructors with their plans, keyed by the files for which they planned."""

    def __init__(self) -> None:
        self._planner = Planner(folder=None, effort="FFTW_ESTIMATE")
        self._kept: OrderedDict[tuple[object, ...], FileReconstructor] = OrderedDict()

    def __call__(self, file: Path, order: ReconstructOptions, files: tuple[object, ...]) -> Reconstruction:
        """Return the result of `diffuscope reconstruct` on a raw with the options `order`.

        `files` identifies the content of all files but the raw. The durations of the steps, measured three times on
        noise for a deadline, would not be used.
        """
        key = (*files, order.method, order.budget_s)
        if key not in self._kept:
            self._kept[key] = FileReconstructor(order, self._planner, timed=False)
        self._kept.move_to_end(key)
        while len(self._kept) > CACHE_SIZE:
            self._kept.popitem(last=False)
        return self._kept[key](file)


class CaseRunner:
    """Runner of the cases of one eye; reconstructs each with the default schedule and every method (`columns`).

    `peer` makes the pictures of the column PEER. The pictures of the clean case are the references, one per column;
    AssertionError if one is refused.
    """

    def __init__(
        self, eye: Eye, folder: Path, columns: tuple[str, ...] = COLUMNS, peer: LenslessPeer | None = None
    ) -> None:
        self.eye, self.folder, self.columns = eye, folder, columns
        self._peer = peer
        self._solvers = SolverCache()
        self._clean: dict[str, Image] = {}
        self._inside: Mask = eye.clean.simulated.inside
        for cell in self.cells(CLEAN):
            if cell.refused:
                raise AssertionError(f"the clean frame of {eye.name} is refused: {cell.refused}")

    def cells(self, case: Case) -> list[Cell]:
        """Reconstruct the frame of `case` with every column; return one `Cell` per column, in their order."""
        frame = case.build(self.eye)
        return [self._cell(case, frame, column) for column in self.columns]

    def _cell(self, case: Case, frame: HardFrame, column: str) -> Cell:
        raw, order, files = self.files(frame, column)
        try:
            made = self._by_peer(raw, frame) if column == PEER else self._solvers(raw, order, files)
        except (DiffuscopeError, *CRASHES) as error:
            ours = isinstance(error, DiffuscopeError)
            words = error.message if isinstance(error, DiffuscopeError) else f"{type(error).__name__}: {error}"
            words = words.replace(f"{self.folder}/", "")
            return Cell(self.eye.name, case.key, column, None, None, words, (), None, None, None, {}, not ours)
        picture = frame.simulated.sampled(made.picture)
        if case is CLEAN:
            self._clean[column] = picture
        inside = self._region(frame)
        found, clean = (correlation(image, frame.simulated.truth, inside) for image in (picture, self._clean[column]))
        eye = made.report.refraction_dpt
        sphere, sd = (None, None) if eye is None else (eye.get("sphere"), eye.get("sd"))
        assert not isinstance(sphere, str)
        assert not isinstance(sd, str)
        return Cell(
            self.eye.name,
            case.key,
            column,
            found,
            clean - found,
            "",
            made.report.warnings,
            sphere,
            sd,
            frame.sphere_dpt,
            dict(made.report.quality),
        )

    def _by_peer(self, file: Path, frame: HardFrame) -> Reconstruction:
        """Return the peer's picture of a raw minus the black level, with bad pixels at the median."""
        assert self._peer is not None
        counts = without_bad_pixels(load_raw(file).raw).astype(np.float32) - np.float32(frame.head.camera.black_dn)
        (made,) = self._peer(counts, frame.psf)
        if not np.isfinite(made.picture).all():
            raise ArithmeticError("the picture is not finite")
        return Reconstruction(made.picture, Report(made.name), simulated=True)

    def _region(self, frame: HardFrame) -> Mask:
        if frame.seen is None:
            return self._inside
        return self._inside & (frame.simulated.sampled(frame.seen.astype(np.float32)) > 0.99)

    def files(self, frame: HardFrame, column: str) -> tuple[Path, ReconstructOptions, tuple[object, ...]]:
        """Write the input files; return the raw, the options for `column`, and the cache key of all files but the raw.

        The files are raw, PSF, head file and flat frame. The key holds the hashes of the PSF and of the flat frame's
        NaN mask, and the text of the head file.
        """
        raw, psf, head = (self.folder / name for name in ("raw.npy", "psf.npy", "head.toml"))
        np.save(raw, frame.raw)
        np.save(psf, frame.psf)
        head.write_text(head_toml(frame.head), encoding="utf-8")
        flat = None
        if frame.flat is not None:
            flat = self.folder / "flat.npy"
            np.save(flat, frame.flat)
        order = ReconstructOptions(
            psfs=(psf,),
            method=None if column == DEFAULT_SCHEDULE else column,
            budget_s=LONG_DEADLINE_S if column == DEFAULT_SCHEDULE else None,
            flat=flat,
            head=head,
            plans=self.folder,
        )
        content = (frame.psf.tobytes(), b"" if frame.flat is None else np.isnan(frame.flat).tobytes())
        return raw, order, (*map(hash, content), head_toml(frame.head))


def correlation(picture: Image, truth: Image, inside: Mask) -> float:
    """Return Pearson's correlation inside a region; 0 if one image is constant there."""
    return pcc(picture.astype(np.float64), truth.astype(np.float64), inside)
