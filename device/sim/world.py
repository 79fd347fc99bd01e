"""Simulated world: the state that simulated camera, lamp and chips share."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import SettingError
from device.sim.blinks import lid_share
from device.sim.effects.illumination import light_of_cap
from device.sim.eyes import EffectSelector, RenderedEyes, lit_deg
from device.sim.fundus import Fundus
from device.sim.optical_setup import OpticalSetup, Scene
from device.sim.plan import Decision, decide
from device.sim.render import crop_or_pad, psf
from device.sim.sensor import SensorModel
from device.values import BatteryState, Colour, Eye, Geometry, HeadIdentity, Illumination, Image

REFERENCE_C = 25.0  # temperature at which the dark current is that of the scene file
FAULTS = frozenset(
    {
        "camera.missing",
        "camera.stalled",
        "camera.mode",
        "light.fault",
        "light.silent",
        "bus.silent",
        "eye.closed",
        "eye.other",
    }
)

FELLOW_EYE: dict[Eye, Eye] = {"OD": "OS", "OS": "OD"}


class World:
    """Shared state of a simulated head: retina, eye, diffuser, lamp, calibration target and faults.

    `eye` is the present one of `eyes`, turned to its fixation target; a test may assign the eyes of another scene. A
    procedural left retina is the mirror image of a right one; a photograph is not mirrored. `choose` selects the
    effects for each colour of light.
    `ambient_e_per_s` is ambient light in addition to the scene's. `target` is the light of a calibration target
    (`calibration_targets.py`), electrons per second (rows, cols): it replaces the eye, does not depend on the lamp, and
    shifts by `shake_px` columns in every second frame. `faults` holds the active faults: "camera.missing",
    "camera.stalled", "camera.mode" (every other pixel), "light.fault", "light.silent" (commands do not reach the LEDs,
    which keep their state), "bus.silent", "eye.closed" (lid closed or no eye: uniform light), "eye.other" (the operator
    presents the other eye).
    """

    def __init__(
        self,
        spec: InstrumentSpec,
        clock: Clock,
        *,
        eye: Eye = "OD",
        ambient_e_per_s: float = 0.0,
        choose: EffectSelector = decide,
    ) -> None:
        self.spec, self.clock, self.eye = spec, clock, eye
        self.eyes = RenderedEyes(spec, eye, choose)
        self.scene: Scene = self.eyes.scene
        self.ambient_e_per_s = ambient_e_per_s
        self.illumination: Illumination | None = None
        self.target: Image | None = None
        self.shake_px = 0
        self.faults: set[str] = set()
        self.frames = 0
        self.lit_frames = 0  # since the lamp was turned on
        self.temperature_c = REFERENCE_C
        self.battery_state = BatteryState(0.775, 3.88)
        self.identity: HeadIdentity | None = None
        self.pressed_since_s: float | None = None

    def has_fault(self, part: str) -> bool:
        """Return true if the fault named `part` is active; SettingError if `faults` contains an unknown name."""
        if unknown := self.faults - FAULTS:
            raise SettingError(
                f"no fault is called {sorted(unknown)[0]!r}", f"Choose from {', '.join(sorted(FAULTS))}."
            )
        return part in self.faults

    def present_eye(self, eye: Eye, field: str | None = None) -> None:
        """Present an eye to the head, with the fault "eye.other" the fellow eye; a calibration target stays in place.

        The eye turns to the fixation target of a field of view; None: it looks straight on. Its light is computed now
        for the picture's and the aiming colour, not later while the lamp is lit: with motion for each frame of a burst.
        """
        self.eye = FELLOW_EYE[eye] if self.has_fault("eye.other") else eye
        self.eyes = self.eyes.turned_to(self.eye, field)
        for colour in {self.spec.light.colour, self.spec.light.preview_colour}:
            self.electrons_per_s(colour)
        self.eyes.render_burst(self.eye, self.spec.camera.exposure_s)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the sensor."""
        return self.spec.camera.rows, self.spec.camera.cols

    @property
    def geometry(self) -> Geometry:
        """Scale between degrees at the eye and pixels of this sensor."""
        return self.scene.geometry

    @property
    def plan(self) -> tuple[Decision, ...]:
        """Decision for each effect, simulated or skipped, for the picture's colour."""
        return self.eyes.plan

    @property
    def sensor(self) -> SensorModel:
        """Sensor model, the same for every colour.

        With a calibration target, full well and white level are limited even if saturation is not simulated.
        """
        sensor = self.setup(self.spec.light.colour).sensor
        camera = self.spec.camera
        if self.target is None:
            return sensor
        return replace(sensor, full_well_e=camera.full_well_e, white_dn=camera.white_dn)

    @property
    def retina(self) -> Fundus:
        """Object of the scene for the present eye, see `RenderedEyes.retina`."""
        return self.eyes.retina(self.eye)

    def setup(self, colour: Colour) -> OpticalSetup:
        """Return the optical setup of the present eye for one colour, with its selected effects."""
        return self.eyes.setup(self.eye, colour)

    def truth(self, colour: Colour) -> Image:
        """Return the ground truth on the sensor grid, float32 (rows, cols): reflectance, ending as the light does."""
        plane = self.retina.plane(colour)
        if lit_deg(self.scene, self.plan) > self.scene.optics.field_deg:
            plane = plane * light_of_cap(self.scene, plane.shape)
        return crop_or_pad(plane, self.shape)

    def psf(self, colour: Colour) -> Image:
        """Return the noise-free PSF of a colour on the axis, with the eye's refraction, (n, n) at sensor pitch."""
        return psf(self.setup(colour))

    def electrons_per_s(self, colour: Colour) -> Image:
        """Return the noise-free electrons per second of the present eye with one colour at full drive.

        float32 (rows, cols), computed once per eye and colour. Without stray light and uneven response the green peak
        reaches `sim.peak_e` in `camera.exposure_s`.
        """
        return self.eyes.electrons_per_s(self.eye, colour)

    def electrons(self, exposure_s: float, begin_s: float | None = None) -> Image:
        """Return the expected electrons of an exposure, (rows, cols): of the target, else of eye, lamp and ambient.

        `begin_s`: when it began, seconds of the clock; by default, it ends now.
        """
        if self.target is not None:
            target = np.roll(self.target, self.shake_px, axis=1) if self.frames % 2 == 0 else self.target
            return (target + np.float32(self.dark_e_per_s)) * np.float32(exposure_s)
        unlit_e_per_s = self.dark_e_per_s + self._ambient_light_e_per_s + self.ambient_e_per_s
        unlit_e = np.asarray(unlit_e_per_s * exposure_s, np.float32)
        illumination = self.illumination  # read once: the guard's thread may turn the lamp off at any time
        if illumination is None:
            return np.broadcast_to(unlit_e, self.shape)
        step, parts = 0, 1
        if illumination.colour == self.spec.light.colour:
            step = self.lit_frames if self.eyes.moves else 0
            parts = self.eyes.parts(exposure_s)
        returned: Image | float = self.eyes.electrons_per_s(self.eye, illumination.colour, step, parts)
        begin_s = self.clock.now_s() - exposure_s if begin_s is None else begin_s
        closed = 1.0 if self.has_fault("eye.closed") else lid_share(self.scene, max(begin_s, 0.0), exposure_s)
        if closed > 0:
            lid = np.full(self.shape, np.mean(returned), np.float32)
            returned = lid if closed == 1 else np.float32(closed) * lid + np.float32(1 - closed) * returned
        light_of_rows = self.setup(illumination.colour).calibrated.light_of_rows
        if light_of_rows is not None:
            returned = light_of_rows(begin_s, exposure_s) * returned
        return returned * np.float32(illumination.level * exposure_s) + unlit_e

    @property
    def dark_e_per_s(self) -> float:
        """Dark current of a pixel at the present temperature, electrons per second; doubles every `dark_doubling_c`."""
        warmer_c = self.temperature_c - REFERENCE_C
        return self.setup(self.spec.light.colour).dark_e_per_s * float(
            2 ** (warmer_c / self.scene.sim.sensor.dark_doubling_c)
        )

    @cached_property
    def _ambient_light_e_per_s(self) -> Image | float:
        """Ambient light of the scene, electrons per second with the lamp on or off: one number, or (rows, cols)."""
        setup = self.setup(self.spec.light.colour)
        added = setup.added_light
        if not added.ambient:
            return 0.0
        self.electrons_per_s(self.spec.light.colour)  # sets lit_e_per_s, the reference of the share
        room_e_per_s = added.ambient * added.lit_e_per_s
        response = setup.whole_response
        return room_e_per_s if response is None else np.float32(room_e_per_s) * response
