"""Hard frames: simulated exposures of an eye, with the files that a user provides beside the raw."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.sim.optical_setup import Scene
from device.sim.render import crop_or_pad
from device.sim.scene_files import SimulatedExposure, lit_frames
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Image, Mask
from services import resources
from tests.paper.bench import HeadChanges, SimulatedFrame, with_changes, with_merged_pixels

SOFT_DEG = 0.5  # width of the transition at a lid's edge or at the edge of the light
Pixels = NDArray[Any]
Floats = NDArray[np.float64]
Shade = Callable[[Floats, Floats], Floats]  # degrees to the right and down -> transmitted share of the light


@dataclass(frozen=True)
class HardFrame:
    """A raw frame (rows, cols) with its truth and the other input files.

    `simulated` holds truth, region and geometry; `raw` is the content of the raw file; `head` that of the head file,
    which may be wrong; `flat` marks declared bad pixels with NaN. `sphere_dpt` is the true spectacle correction of the
    frame's eye, relative to the eye of the PSF (negative: myopia); None if undefined. `seen` is the lit part of the
    field; None: all of it.
    """

    simulated: SimulatedFrame
    raw: Pixels
    psf: Image
    head: InstrumentSpec
    sphere_dpt: float | None
    flat: Image | None = None
    seen: Mask | None = None

    def with_raw(self, raw: Pixels, **changes: Any) -> "HardFrame":
        """Return the same frame with other counts in the raw file, and other fields by `changes`."""
        return replace(self, raw=raw, **changes)


@dataclass(frozen=True)
class Eye:
    """One eye before one head: name of a shipped head file, changes to its keys; `merged` n combines n x n pixels."""

    name: str
    head: str
    changes: HeadChanges = field(default_factory=dict)
    merged: int = 1

    @property
    def spec(self) -> InstrumentSpec:
        """Return the simulated head with its changes and merged pixels."""
        backends = {"camera.backend": "sim", "light.backend": "sim"}
        return with_merged_pixels(
            with_changes(load_head(resources.HEADS / f"{self.head}.toml"), backends | dict(self.changes)), self.merged
        )

    @cached_property
    def clean(self) -> HardFrame:
        """Return the frame without a defect."""
        return self.frame()

    @cached_property
    def expected_e(self) -> Image:
        """Expected electrons per pixel of the clean frame, float32 (rows, cols), without noise and clipping."""
        spec = self.spec
        return World(spec, VirtualClock()).electrons_per_s(spec.light.colour) * np.float32(spec.camera.exposure_s)

    @property
    def peak_e(self) -> float:
        """Return the electrons in the brightest pixel of the clean frame."""
        spec = self.spec
        return Scene(spec, spec.light.colour).peak_e

    def frame(self, changes: HeadChanges | None = None, shade: Shade | None = None) -> HardFrame:
        """Expose a frame with `changes` to keys of the head or scene; `shade` is the transmission over the field.

        The PSF is that of the changed head; the returned `head` is the unchanged one.
        """
        spec = with_changes(self.spec, changes or {})
        assert spec.sim is not None
        exposed, seen = _exposed(spec, shade)
        undone_dpt = _relative_dpt(spec)
        return HardFrame(
            SimulatedFrame(self.name, exposed),
            exposed.counts,
            exposed.calibration.psfs[0].pixels,
            self.spec,
            undone_dpt,
            seen=seen,
        )


def _relative_dpt(spec: InstrumentSpec) -> float:
    """Return the spectacle correction in dpt of the frame's eye relative to the PSF's eye (negative: myopia).

    The PSF of an eye of mean sphere M is that of a relaxed eye scaled by 1 - s M (OPTICS.md 2.6), so the ratio of both
    scales counts.
    """
    assert spec.sim is not None
    assert spec.optics is not None
    per_dpt = spec.optics.geometry(spec.camera.pitch_um).scale_per_dpt
    eye, of_psf = (1 - per_dpt * m_dpt for m_dpt in (spec.sim.eye.m_dpt, spec.sim.calibration.m_dpt))
    return -(1 - eye / of_psf) / per_dpt


def _exposed(spec: InstrumentSpec, shade: Shade | None) -> tuple[SimulatedExposure, Mask | None]:
    world = World(spec, VirtualClock())
    colour = spec.light.colour
    truth, seen = world.truth(colour), None
    if shade is not None:
        setup = world.setup(colour)
        left = _shares(shade, setup.object.shape, world.geometry.px_per_deg)
        setup.object = setup.object * left
        on_sensor = crop_or_pad(left, world.shape)
        truth, seen = truth * on_sensor, on_sensor > 0.99
    (counts,) = lit_frames(world)
    return SimulatedExposure(counts, truth, None, simulated_calibration(world)), seen


def _shares(shade: Shade, shape: tuple[int, ...], px_per_deg: float) -> Image:
    down, right = ((np.arange(n) - (n - 1) / 2) / px_per_deg for n in shape)
    return np.asarray(shade(np.broadcast_to(right, shape), np.broadcast_to(down[:, None], shape)), np.float32)


def above_dark(down_deg: float) -> Shade:
    """Return the shade of a lid: no light above a line `down_deg` below the axis, with an edge SOFT_DEG wide."""
    return lambda right, down: np.clip((down - down_deg) / SOFT_DEG + 0.5, 0, 1)


def crescent_dark(moved_deg: float, radius_deg: float) -> Shade:
    """Return the shade of a decentred pupil: light only in a disc of `radius_deg`, shifted left by `moved_deg`.

    Its edge is SOFT_DEG wide.
    """
    return lambda right, down: np.clip((radius_deg - np.hypot(right + moved_deg, down)) / SOFT_DEG + 0.5, 0, 1)


@cache
def head_toml(spec: InstrumentSpec) -> str:
    """Return the TOML text of a head file with the spec's camera and optics, light backend "sim" and seed 1."""
    assert spec.optics is not None
    camera = spec.camera.model_dump(exclude_none=True, exclude={"sensor"})
    optics = spec.optics.model_dump(exclude_none=True)
    tables = {"camera": camera, "light": {"backend": "sim"}, "optics": optics, "sim": {"seed": 1}}
    return tomli_w.dumps({"name": "Head of a hard case"} | tables)
