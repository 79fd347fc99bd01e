"""Eyes in front of a simulated head: object, optical setup and light of each eye and colour, computed once."""

from collections.abc import Callable
from functools import cached_property

import numpy as np

from device.config.head_file import InstrumentSpec
from device.sim.fundus import Fundus
from device.sim.objects import draw_object
from device.sim.optical_setup import OpticalSetup, Scene
from device.sim.plan import Decision, build_setup
from device.sim.render import electrons_per_s
from device.values import Colour, Eye, Image

EffectSelector = Callable[[Scene], tuple[Decision, ...]]


class RenderedEyes:
    """Retinas, setups and images of both eyes of a scene; `choose` selects the effects for each colour of light.

    `scene` is the scene in the picture's colour, with the eye that is present first.
    """

    def __init__(self, spec: InstrumentSpec, eye: Eye, choose: EffectSelector) -> None:
        self.scene = Scene(spec, spec.light.colour, eye)
        self._choose = choose
        self._setups: dict[tuple[Eye, Colour], OpticalSetup] = {}
        self._rates: dict[tuple[Eye, Colour], Image] = {}
        self._retinas: dict[Eye, Fundus] = {}

    @cached_property
    def plan(self) -> tuple[Decision, ...]:
        """Decision for each effect, simulated or skipped, for the picture's colour."""
        return self._choose(self.scene)

    def retina(self, eye: Eye) -> Fundus:
        """Return the object of the scene for an eye (retina, photograph or drawing), drawn once per eye.

        It covers the whole field and may be larger than the sensor. Its rows and columns have the parity of the
        sensor's, so that the centres coincide.
        """
        if eye not in self._retinas:
            scene, camera = self.scene, self.scene.spec.camera
            px_per_deg = scene.geometry.px_per_deg
            wide = int(np.ceil(px_per_deg * scene.optics.field_deg)) + 4
            shape = (wide + (wide - camera.rows) % 2, wide + (wide - camera.cols) % 2)
            self._retinas[eye] = draw_object(scene.sim, scene.optics, eye, shape, px_per_deg)
        return self._retinas[eye]

    def setup(self, eye: Eye, colour: Colour) -> OpticalSetup:
        """Return the optical setup of an eye in one colour with its selected effects, built once per eye and colour."""
        key = eye, colour
        if key not in self._setups:
            spec = self.scene.spec
            scene = Scene(spec, colour, eye)
            chosen = self.plan if colour == spec.light.colour else self._choose(scene)
            self._setups[key] = build_setup(scene, self.retina(eye), chosen)
        return self._setups[key]

    def electrons_per_s(self, eye: Eye, colour: Colour) -> Image:
        """Return the noise-free electrons per second of an eye with one colour at full drive, float32 (rows, cols).

        Computed once per eye and colour.
        """
        key = eye, colour
        if key not in self._rates:
            self._rates[key] = electrons_per_s(self.setup(eye, colour))
        return self._rates[key]
