"""The columns of the grid: each hard frame through `diffuscope reconstruct` with every method, and as the instrument.

A frame becomes the files that a user gives (raw, PSF, head file, flat frame), and the command's own functions read
them. Only the planned solver is kept from one frame to the next of the same files; a command plans it every time.
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

LADDER = "ladder"  # as the instrument: the quick look, the refraction, then the rounds
COLUMNS = (LADDER, *METHODS)
PATIENT_S = 600.0  # a deadline that cuts nothing off
CRASHES = (ArithmeticError, ValueError, LookupError, TypeError)  # what no user may ever see; a column of its own
KEPT = 8  # planned solvers at a time: each of a full sensor holds about 300 MB at most


@dataclass(frozen=True)
class Cell:
    """What one method made of one frame.

    `pcc` is the correlation with the truth inside the lit field, `lost` what it is below the same method's clean frame
    there; both None where the frame was refused with `refused`, or the solver `crashed` with these words. `sphere_dpt`
    with `sd_dpt` is the refraction given, None where none is; `true_dpt` is the one that the frame holds, None where it
    holds none.
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
        """One row."""
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
        """The files of a frame, written, and the order of a column; and what the files but the raw hold."""
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
