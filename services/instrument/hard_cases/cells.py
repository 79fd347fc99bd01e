"""The columns of the grid: each hard frame, reconstructed with every method and with the instrument's default sequence.

A frame is written as the files that a user gives (raw, PSF, head file, flat frame), and the functions of
`diffuscope reconstruct` read them. The planned solver is kept for frames with the same other files; the command plans
it every time.
"""

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from device.clock import Deadline
from device.errors import DiffuscopeError
from device.images import Raw, as_raw, read_image
from device.recon.methods import METHODS
from device.recon.metrics import pcc
from device.recon.plan import Planner
from device.recon.reconstructor import Reconstructor
from device.values import Image, Mask, Reconstruction
from services.instrument.hard_cases.cases import CLEAN, Case
from services.instrument.hard_cases.frames import Eye, HardFrame, head_toml
from services.instrument.once import Order, calibrated, planned

LADDER = "ladder"  # the instrument's default sequence: quick look, refraction, iterations
COLUMNS = (LADDER, *METHODS)
PATIENT_S = 600.0  # a deadline that cuts nothing off
CRASHES = (ArithmeticError, ValueError, LookupError, TypeError)  # no user may see these; reported as `Cell.crashed`
KEPT = 8  # planned solvers at a time: each of a full sensor holds about 300 MB at most


@dataclass(frozen=True)
class Cell:
    """The result of one method on one frame.

    `pcc` (-1 to 1) is the correlation with the truth inside the lit field, `lost` the clean picture's `pcc` of the same
    method minus it. Both are None if the frame was refused with the message `refused`, or if the solver `crashed`.
    `sphere_dpt` with `sd_dpt` is the estimated, `true_dpt` the true spectacle correction (negative: myopia), relative
    to the eye of the PSF: minus `Refraction.sphere_dpt`. None: not estimated, or undefined for the frame.
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
        """The error of the refraction in its own standard deviations."""
        if self.sphere_dpt is None or self.sd_dpt is None or self.true_dpt is None:
            return None
        return (self.sphere_dpt - self.true_dpt) / max(self.sd_dpt, 1e-9)


class Solvers:
    """Planned solvers by the files that they were planned for; the least recently used ones go."""

    def __init__(self) -> None:
        self._planner = Planner(folder=None, effort="FFTW_ESTIMATE")
        self._kept: OrderedDict[tuple[object, ...], Reconstructor] = OrderedDict()

    def __call__(self, order: Order, files: tuple[object, ...]) -> Reconstruction:
        """What `diffuscope reconstruct` makes of an order; `files` names the content of all files but the raw."""
        raw = as_raw(read_image(order.raw))
        known = raw.stored_bits, raw.white_dn, raw.bad.tobytes() if raw.bad.any() else b""
        key = (*files, order.method, order.budget_s, *known)
        if key not in self._kept:
            self._kept[key] = self._planned(order, raw)
        self._kept.move_to_end(key)
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        make = self._kept[key]
        deadline = None if order.budget_s is None else Deadline.after(make.clock, order.budget_s)
        return make(raw.pixels, simulated=True, deadline=deadline)

    def _planned(self, order: Order, raw: Raw) -> Reconstructor:
        shape = raw.pixels.shape[0], raw.pixels.shape[1]
        return planned(order, calibrated(order, raw), shape, self._planner, 0)


class Grid:
    """Runs cases of one eye through the columns; keeps the clean pictures that all others are compared with."""

    def __init__(self, eye: Eye, folder: Path, columns: tuple[str, ...] = COLUMNS) -> None:
        self.eye, self.folder, self.columns = eye, folder, columns
        self._solvers = Solvers()
        self._clean: dict[str, Image] = {}
        self._inside: Mask = eye.clean.take.inside
        for cell in self.cells(CLEAN):
            if cell.refused:
                raise AssertionError(f"the clean frame of {eye.name} is refused: {cell.refused}")

    def cells(self, case: Case) -> list[Cell]:
        """Reconstruct the frame of `case` with every column; return one `Cell` per column, in their order."""
        frame = case.build(self.eye)
        return [self._cell(case, frame, column) for column in self.columns]

    def _cell(self, case: Case, frame: HardFrame, column: str) -> Cell:
        order, files = self.files(frame, column)
        try:
            made = self._solvers(order, files)
        except (DiffuscopeError, *CRASHES) as error:
            ours = isinstance(error, DiffuscopeError)
            words = error.message if isinstance(error, DiffuscopeError) else f"{type(error).__name__}: {error}"
            return Cell(self.eye.name, case.key, column, None, None, words, (), None, None, None, {}, not ours)
        picture = frame.take.sampled(made.picture)
        if case is CLEAN:
            self._clean[column] = picture
        inside = self._region(frame)
        found, clean = (likeness(one, frame.take.truth, inside) for one in (picture, self._clean[column]))
        eye = made.report.refraction_dpt
        sphere, sd = (None, None) if eye is None else (eye.get("sphere"), eye.get("sd"))
        return Cell(
            self.eye.name, case.key, column, found, clean - found, "", made.report.warnings, sphere, sd,
            frame.sphere_dpt, dict(made.report.quality),
        )  # fmt: skip

    def _region(self, frame: HardFrame) -> Mask:
        if frame.seen is None:
            return self._inside
        return self._inside & (frame.take.sampled(frame.seen.astype(np.float32)) > 0.99)

    def files(self, frame: HardFrame, column: str) -> tuple[Order, tuple[object, ...]]:
        """Write raw, PSF, head file and flat; return the order for `column`, and a cache key of all files but the raw.

        The key holds the hashes of the PSF and of the flat's NaN mask, and the head file's text.
        """
        raw, psf, head = (self.folder / name for name in ("raw.npy", "psf.npy", "head.toml"))
        np.save(raw, frame.raw)
        np.save(psf, frame.psf)
        head.write_text(head_toml(frame.head), encoding="utf-8")
        flat = None
        if frame.flat is not None:
            flat = self.folder / "flat.npy"
            np.save(flat, frame.flat)
        order = Order(
            raw=raw, psfs=(psf,), output=self.folder / "picture.npy", method=None if column == LADDER else column,
            budget_s=PATIENT_S if column == LADDER else None, dark=None, flat=flat, head=head, field_deg=None,
            even=False, plans=self.folder,
        )  # fmt: skip
        content = (frame.psf.tobytes(), b"" if frame.flat is None else np.isnan(frame.flat).tobytes())
        return order, (*map(hash, content), head_toml(frame.head))


def likeness(picture: Image, truth: Image, inside: Mask) -> float:
    """Pearson's correlation inside a region."""
    return pcc(picture.astype(np.float64), truth.astype(np.float64), inside)
