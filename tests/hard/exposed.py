"""Frames of one eye behind a head's diffuser, with what a head or a lamp adds to them, and their solver."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from device.clock import VirtualClock
from device.config.head_file import load_head
from device.recon.assessment.metrics import pcc
from device.recon.model.field_of_view import field_radius_px
from device.recon.reconstructor import Reconstructor
from device.sim.fundus import field_mask
from device.sim.scene_files import lit_frames
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Counts, Image, Reconstruction
from services import resources
from tests import scenes
from tests.hard import defects
from tests.paper.bench import with_changes
from tests.simulated import coarse


class Exposed:
    """Frames of one drawn eye, or of a photograph, behind a head's diffuser, and its solvers."""

    def __init__(
        self,
        head: str,
        m_dpt: float,
        peak_e: float,
        photo: Path | None = None,
        frames: int = 1,
        more: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        changes = {"camera.backend": "sim", "light.backend": "sim", "sim.peak_e": peak_e, "sim.seed": 5}
        changes |= {"sim.eye.m_dpt": m_dpt, **more}
        if photo is not None:
            changes |= {"sim.object.kind": "image", "sim.object.image": str(photo)}
        self.spec = coarse(with_changes(load_head(resources.HEADS / f"{head}.toml"), changes), 2)
        of = World(self.spec, VirtualClock())
        self.calibration = simulated_calibration(of)
        self.truth = of.truth(self.spec.light.colour).astype(np.float64)
        self.frames = lit_frames(of, frames)
        self.inside = field_mask(of.shape, field_radius_px(self.calibration))
        self.make = Reconstructor(self.calibration, of.shape, scenes.PLANNER, VirtualClock())

    def banded(self, share: float, frame: int = 0) -> Counts:
        """Return a frame with bands of +- `share`, whose phase differs from frame to frame."""
        return defects.bands(self.frames[frame], self.spec.camera, share, phase=0.3 + 0.37 * frame)

    def under(self, share: Image, added: Image) -> Counts:
        """Return the counts with their light above black times `share` plus `added` (in means of the light)."""
        camera = self.spec.camera
        light = self.frames[0].astype(np.float32) - camera.black_dn
        lit = np.rint(camera.black_dn + light * share + added * light.mean())
        return np.clip(lit, 0, camera.white_dn).astype(self.frames[0].dtype)

    def pcc(self, made: Reconstruction) -> float:
        return pcc(made.picture.astype(np.float64), self.truth, self.inside)


@cache
def exposed(head: str, m_dpt: float, peak_e: float) -> Exposed:
    """Return one frame of the drawn eye."""
    return Exposed(head, m_dpt, peak_e)
