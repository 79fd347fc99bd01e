"""The one world that the simulated camera and lamp share: retina, eye, diffuser, and what the lamp does now."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from device.clock import Clock
from device.errors import SettingError
from device.sim.fundus import Fundus
from device.sim.objects import drawn
from device.sim.plan import Decision, decide, prepared
from device.sim.render import electrons_per_s, fitted, psf
from device.sim.sensor import SensorModel
from device.sim.setup import Scene, Setup
from device.spec import InstrumentSpec, OpticsSpec
from device.values import Charge, Colour, Eye, Geometry, Glow, Identity, Image

REFERENCE_C = 25.0  # where a scene's dark current is that of its file
FAULTS = frozenset({
    "camera.missing", "camera.stalled", "camera.mode", "light.fault", "light.silent", "bus.silent", "eye.closed",
    "eye.other",
})  # fmt: skip

OTHER: dict[Eye, Eye] = {"OD": "OS", "OS": "OD"}
Choice = Callable[[Scene], tuple[Decision, ...]]


class World:
    """A retina behind an eye behind the diffuser, and the state of the lamp.

    `eye` is the one that looks in now: of the procedural retina, a left one is a right one's mirror image, and a
    photograph stays what it is. `choose` decides which effects each colour of light calls for;
    `ambient_e_per_s` is light that comes without the lamp, beside what the scene says. `stage` is the light of what
    stands there instead of the eye (`stage.py`), electrons per second (rows, cols); no lamp of ours changes it, and it
    moves by `shake_px` columns and back from one frame to the next.
    `faults` holds what is broken now: "camera.missing", "camera.stalled", "camera.mode" (it gives every other pixel),
    "light.fault", "light.silent" (nothing reaches the LEDs, which keep what they show), "bus.silent", "eye.closed" (a
    lid, or no eye at all: the lamp's light comes back from everywhere alike), "eye.other" (whoever holds the head goes
    to the other eye than is asked for).
    """

    def __init__(
        self,
        spec: InstrumentSpec,
        clock: Clock,
        *,
        eye: Eye = "OD",
        ambient_e_per_s: float = 0.0,
        choose: Choice = decide,
    ) -> None:
        self.spec, self.clock, self.eye = spec, clock, eye
        self.scene = Scene(spec, spec.light.colour, eye)
        self.optics: OpticsSpec = self.scene.optics
        self.seed = self.scene.seed
        self.ambient_e_per_s = ambient_e_per_s
        self.glow: Glow | None = None
        self.stage: Image | None = None
        self.shake_px = 0
        self.faults: set[str] = set()
        self.frames = 0
        self.celsius, self.charge = REFERENCE_C, Charge(0.775, 3.88)
        self.identity: Identity | None = None
        self.pressed_since_s: float | None = None
        self._choose = choose
        self._setups: dict[tuple[Eye, Colour], Setup] = {}
        self._rates: dict[tuple[Eye, Colour], Image] = {}
        self._retinas: dict[Eye, Fundus] = {}

    def broken(self, part: str) -> bool:
        """Whether a part has its fault now; SettingError if `faults` names one that does not exist."""
        if strange := self.faults - FAULTS:
            raise SettingError(
                f"no fault is called {sorted(strange)[0]!r}", f"Choose from {', '.join(sorted(FAULTS))}."
            )
        return part in self.faults

    def meet(self, eye: Eye) -> None:
        """The head is held before that eye from now on, or before the other one; its light is traced while it is dark.

        Where something else stands there, it stays.
        """
        self.eye = OTHER[eye] if self.broken("eye.other") else eye
        for colour in {self.spec.light.colour, self.spec.light.preview_colour}:
            self.electrons_per_s(colour)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        return self.spec.camera.rows, self.spec.camera.cols

    @property
    def geometry(self) -> Geometry:
        """How degrees at the eye become pixels of this sensor."""
        return self.scene.geometry

    @cached_property
    def plan(self) -> tuple[Decision, ...]:
        """What is simulated of the picture's colour, and what is left out."""
        return self._choose(self.scene)

    @property
    def sensor(self) -> SensorModel:
        """The sensor, the same in every light; before a stage, however bright, its wells and its converter end."""
        sensor, camera = self.setup(self.spec.light.colour).sensor, self.spec.camera
        if self.stage is None:
            return sensor
        return replace(sensor, full_well_e=camera.full_well_e, white_dn=camera.white_dn)

    @property
    def retina(self) -> Fundus:
        """The whole object in the field, on a square as wide as the field: it may be larger than the sensor.

        Rows and columns are even or odd as the sensor's are, so that their middles fall together.
        """
        if self.eye not in self._retinas:
            px_per_deg = self.geometry.px_per_deg
            wide = int(np.ceil(px_per_deg * self.optics.field_deg)) + 4
            shape = (wide + (wide - self.shape[0]) % 2, wide + (wide - self.shape[1]) % 2)
            self._retinas[self.eye] = drawn(self.scene.sim, self.optics, self.eye, shape, px_per_deg)
        return self._retinas[self.eye]

    def setup(self, colour: Colour) -> Setup:
        """The light's way in one colour, with the effects that it calls for."""
        mine = self.eye, colour
        if mine not in self._setups:
            scene = Scene(self.spec, colour, self.eye)
            chosen = self.plan if colour == self.spec.light.colour else self._choose(scene)
            self._setups[mine] = prepared(scene, self.retina, chosen)
        return self._setups[mine]

    def truth(self, colour: Colour) -> Image:
        """The object on the sensor grid: reflectance, float32 (rows, cols), zero outside the field."""
        return fitted(self.retina.reflectance[colour], self.shape)

    def psf(self, colour: Colour) -> Image:
        """The noise-free caustic of a colour on the axis, at the sensor's pitch, (n, n), of this world's eye."""
        return psf(self.setup(colour))

    def electrons_per_s(self, colour: Colour) -> Image:
        """Electrons per second at full drive of one colour, float32 (rows, cols): without noise, computed once.

        The green peak reaches `sim.peak_e` in `camera.exposure_s`.
        """
        mine = self.eye, colour
        if mine not in self._rates:
            self._rates[mine] = electrons_per_s(self.setup(colour))
        return self._rates[mine]

    def electrons(self, exposure_s: float) -> Image:
        """The electrons that are expected in an exposure under the lamp as it is now; float32 (rows, cols)."""
        if self.stage is not None:
            there = np.roll(self.stage, self.shake_px, axis=1) if self.frames % 2 else self.stage
            return (there + np.float32(self.dark_e_per_s)) * np.float32(exposure_s)
        always_e_per_s = self.dark_e_per_s + self._room_e_per_s + self.ambient_e_per_s
        always_e = np.asarray(always_e_per_s * exposure_s, np.float32)
        glow = self.glow  # once: a guard may darken the lamp at any moment
        if glow is None:
            return np.broadcast_to(always_e, self.shape)
        returned: Image | float = self.electrons_per_s(glow.colour)
        if self.broken("eye.closed"):
            returned = np.full(self.shape, np.mean(returned), np.float32)
        return returned * np.float32(glow.level * exposure_s) + always_e

    @property
    def dark_e_per_s(self) -> float:
        """What the sensor's warmth adds, as warm as it is now."""
        warmer_c = self.celsius - REFERENCE_C
        return self.setup(self.spec.light.colour).dark_e_per_s * float(
            2 ** (warmer_c / self.scene.sim.sensor.dark_doubling_c)
        )

    @cached_property
    def _room_e_per_s(self) -> Image | float:
        """What the scene's room adds, lamp or no lamp."""
        setup = self.setup(self.spec.light.colour)
        if not setup.ambient:
            return 0.0
        self.electrons_per_s(self.spec.light.colour)  # says how bright the picture is, of which this is a share
        room_e_per_s = setup.ambient * setup.lit_e_per_s
        return room_e_per_s if setup.response is None else np.float32(room_e_per_s) * setup.response
