"""Hard frames: an eye before a head, exposed by the simulator, with the files that a user would give beside the raw."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from device.clock import VirtualClock
from device.sim.calibrate import simulated_calibration
from device.sim.camera import SimCamera
from device.sim.light import SimLight
from device.sim.render import fitted
from device.sim.staged import Staged
from device.sim.world import World
from device.spec import InstrumentSpec, load_head
from device.values import Glow, Image, Mask, Shot
from services import resources
from services.instrument.paper.bench import Take, changed, merged

SOFT_DEG = 0.5  # over which a lid's edge or the edge of the light falls off
Pixels = NDArray[Any]
Floats = NDArray[np.float64]
Shade = Callable[[Floats, Floats], Floats]  # degrees to the right and down -> share of the light that is left


@dataclass(frozen=True)
class HardFrame:
    """A raw frame (rows, cols) with its truth, and what the user hands over with it.

    `take` holds truth, region and geometry; `raw` is the content of the raw file; `head` that of the head file, which
    may be wrong; `flat` marks declared bad pixels with NaN. `sphere_dpt` is the true spectacle correction of the
    frame's eye, relative to the eye of the PSF (negative: myopia); None if undefined. `seen` is the lit part of the
    field.
    """

    take: Take
    raw: Pixels
    psf: Image
    head: InstrumentSpec
    sphere_dpt: float | None
    flat: Image | None = None
    seen: Mask | None = None

    def with_raw(self, raw: Pixels, **changes: Any) -> "HardFrame":
        """The same frame with other counts in the file."""
        return replace(self, raw=raw, **changes)


@dataclass(frozen=True)
class Eye:
    """One eye before one head: a head file, and the keys that make its scene; `merged` n makes n x n pixels one."""

    name: str
    head: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    merged: int = 1

    @property
    def spec(self) -> InstrumentSpec:
        """The head with its scene."""
        backends = {"camera.backend": "sim", "light.backend": "sim"}
        return merged(
            changed(load_head(resources.HEADS / f"{self.head}.toml"), backends | dict(self.changes)), self.merged
        )

    @cached_property
    def clean(self) -> HardFrame:
        """The frame without a defect."""
        return self.frame()

    @cached_property
    def expected_e(self) -> Image:
        """Expected electrons per pixel of the clean frame, float32 (rows, cols), without noise and without clipping."""
        spec = self.spec
        return World(spec, VirtualClock()).electrons_per_s(spec.light.colour) * np.float32(spec.camera.exposure_s)

    @property
    def peak_e(self) -> float:
        """What the brightest pixel of the clean frame collects."""
        sim = self.spec.sim
        assert sim is not None
        return sim.peak_e

    def frame(self, changes: Mapping[str, Any] | None = None, shade: Shade | None = None) -> HardFrame:
        """Expose a frame with `changes` to keys of the head or scene, and with `shade` applied to the field.

        The PSF is that of the changed head; the returned `head` is the unchanged one.
        """
        spec = changed(self.spec, changes or {})
        assert spec.sim is not None
        exposed, seen = _exposed(spec, shade)
        undone_dpt = _relative_dpt(spec)
        return HardFrame(
            Take(self.name, exposed), exposed.counts, exposed.calibration.psfs[0].pixels, self.spec, undone_dpt,
            seen=seen,
        )  # fmt: skip


def _relative_dpt(spec: InstrumentSpec) -> float:
    """The correction that explains the frame of an eye through a PSF taken with another eye.

    The PSF of an eye of M is that of a relaxed one, scaled by 1 - s M (optics.md 4.2), so the ratio of both scales
    counts.
    """
    assert spec.sim is not None
    assert spec.optics is not None
    per_dpt = spec.optics.geometry(spec.camera.pitch_um).scale_per_dpt
    eye, of_psf = (1 - per_dpt * m_dpt for m_dpt in (spec.sim.eye.m_dpt, spec.sim.calibration.m_dpt))
    return -(1 - eye / of_psf) / per_dpt


def _exposed(spec: InstrumentSpec, shade: Shade | None) -> tuple[Staged, Mask | None]:
    world = World(spec, VirtualClock())
    colour = spec.light.colour
    truth, seen = world.truth(colour), None
    if shade is not None:
        setup = world.setup(colour)
        left = _shares(shade, setup.object.shape, world.geometry.px_per_deg)
        setup.object = setup.object * left
        on_sensor = fitted(left, world.shape)
        truth, seen = truth * on_sensor, on_sensor > 0.99
    world.electrons_per_s(colour)
    with SimLight(world).on(Glow(colour)):
        counts = SimCamera(world).expose(Shot(spec.camera.exposure_s)).counts
    return Staged(counts, truth, None, simulated_calibration(world)), seen


def _shares(shade: Shade, shape: tuple[int, ...], px_per_deg: float) -> Image:
    down, right = ((np.arange(n) - (n - 1) / 2) / px_per_deg for n in shape)
    return np.asarray(shade(np.broadcast_to(right, shape), np.broadcast_to(down[:, None], shape)), np.float32)


def above_dark(down_deg: float) -> Shade:
    """A lid: dark above a line so far below the axis."""
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
    tables = {"camera": camera, "light": {"backend": "sim"}, "optics": spec.optics.model_dump(), "sim": {"seed": 1}}
    lines = ['name = "Head of a hard case"']
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)
