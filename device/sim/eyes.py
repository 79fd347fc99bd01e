"""Eyes in front of a simulated head: object, optical setup and light of each eye and colour, computed once."""

from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property

import numpy as np

from device.config.head_file import InstrumentSpec
from device.optics.retina_chart import PAPER_REFLECTANCE
from device.optics.trial_lens import PowerVector, TrialLens, correction_behind
from device.sim.effects.illumination import Penumbra
from device.sim.fundus import FIELD_CENTRE_DEG, Fundus
from device.sim.objects import draw_object, moved_behind_field
from device.sim.optical_setup import OpticalSetup, Scene
from device.sim.plan import Decision, build_setup
from device.sim.render import electrons_per_s
from device.sim.vessels import DISC
from device.values import Colour, Eye, Image

STEPS = 3  # of the drift from the first frame of a burst on; one frame later the eye is at its first place again
MIN_DRIFT_PX = 0.1  # of the retina over a burst: below a tenth of a pixel no frame changes visibly (OPTICS.md 3.9)
MAX_PARTS = 4  # of an exposure; in a split into more each frame still has a quarter of its motion, which is too much
FASTEST_DRIFT_DEG_PER_S = 5.0  # a faster eye, in a saccade, blurs each frame, but is not displaced between frames
EffectSelector = Callable[[Scene], tuple[Decision, ...]]
Pair = tuple[float, float]
STRAIGHT: Pair = (0.0, 0.0)
# Turn of a right eye to the fixation target of a field of view, as the shift of its picture in degrees right and down.
FIXATION_DEG: dict[str, Pair] = {"nerve": (FIELD_CENTRE_DEG[0] - DISC[0], FIELD_CENTRE_DEG[1] - DISC[1])}


class RenderedEyes:
    """Retinas, setups and images of both eyes of a scene; `choose` selects the effects for each colour of light.

    `scene` is the scene in the picture's colour, with the eye that is present first. `turn_deg` is their turn from
    the scene's own gaze, degrees right and down in the picture. What was computed for one turn is kept for the others.
    """

    def __init__(self, spec: InstrumentSpec, eye: Eye, choose: EffectSelector) -> None:
        self.scene = Scene(spec, spec.light.colour, eye)
        self._choose = choose
        self.turn_deg = STRAIGHT
        self._shows_card = False
        self._setups: dict[tuple[Eye, Colour, Pair], OpticalSetup] = {}
        self._rates: dict[tuple[Eye, Colour, int, int, Pair], Image] = {}
        self._retinas: dict[tuple[Eye, Pair], Fundus] = {}

    def turned_to(self, eye: Eye, field: str | None) -> "RenderedEyes":
        """Return these eyes with an eye turned to the fixation target of a field of view.

        None, an unknown field, a photograph and a drawing: no turn.
        """
        turn_deg = FIXATION_DEG.get(field or "", STRAIGHT) if self.scene.sim.object.kind == "retina" else STRAIGHT
        turned = copy(self)
        turned.turn_deg = turn_deg if eye == "OD" else (-turn_deg[0], turn_deg[1])
        return turned

    def behind_lens(self, lens: TrialLens, vertex_mm: float) -> "RenderedEyes":
        """Return the eyes of this scene, looking straight on, with a trial lens at a distance before their pupils, mm.

        The scene's refraction is a wavefront, y downwards; that of lens and eye a correcting lens, y upwards.
        """
        spec = self.scene.spec
        eye = self.scene.sim.eye
        m, j0, j45 = correction_behind(lens, vertex_mm, PowerVector(-eye.m_dpt, -eye.j0_dpt, eye.j45_dpt))
        behind = eye.model_copy(update={"m_dpt": -m, "j0_dpt": -j0, "j45_dpt": j45})
        sim = self.scene.sim.model_copy(update={"eye": behind})
        eyes = RenderedEyes(spec.model_copy(update={"sim": sim}), self.scene.eye, self._choose)
        eyes._retinas = self._retinas
        return eyes

    def behind_card(self) -> "RenderedEyes":
        """Return these eyes with a white card in front of them, in the light of the lamp."""
        covered = copy(self)
        covered._shows_card = True
        return covered

    @cached_property
    def plan(self) -> tuple[Decision, ...]:
        """Decision for each effect, simulated or skipped, for the picture's colour."""
        return self._choose(self.scene)

    def retina(self, eye: Eye) -> Fundus:
        """Return the object of the scene for an eye (retina, photograph or drawing), drawn once per eye and turn.

        It covers the whole lit field and may be larger than the sensor. Its rows and columns have the parity of the
        sensor's, so that the centres coincide.
        """
        key = eye, self.turn_deg
        if key not in self._retinas:
            scene = self.scene
            camera = self.scene.spec.camera
            px_per_deg = scene.geometry.px_per_deg
            light_deg = lit_deg(scene, self.plan)
            wide = int(np.ceil(px_per_deg * light_deg)) + 4
            shape = (wide + (wide - camera.rows) % 2, wide + (wide - camera.cols) % 2)
            self._retinas[key] = draw_object(scene.sim, scene.optics, eye, shape, px_per_deg, self.turn_deg, light_deg)
        return self._retinas[key]

    def setup(self, eye: Eye, colour: Colour) -> OpticalSetup:
        """Return the optical setup of an eye in one colour with its selected effects, built once for each turn."""
        key = eye, colour, self.turn_deg
        if key not in self._setups:
            scene = Scene(self.scene.spec, colour, eye, self.turn_deg)
            self._setups[key] = build_setup(scene, self.retina(eye), self._chosen(scene))
        return self._setups[key]

    @cached_property
    def drift_px(self) -> float:
        """Movement of the retina to the right from one frame of a burst to the next, in pixels.

        The eye drifts by `drift_deg_per_s` for the time of one exposure. 0 if that is too small to be seen, or if the
        speed is above FASTEST_DRIFT_DEG_PER_S.
        """
        speed = self.scene.sim.eye.drift_deg_per_s
        step_deg = (speed if speed <= FASTEST_DRIFT_DEG_PER_S else 0.0) * self.scene.spec.camera.exposure_s
        step_px = step_deg * self.scene.geometry.px_per_deg
        return step_px if STEPS * step_px >= MIN_DRIFT_PX else 0.0

    @cached_property
    def torsion_deg(self) -> float:
        """Turn of the eye about its line of sight from one frame of a burst to the next, degrees; 0 if too small.

        It is simulated if it moves the edge of the field by MIN_DRIFT_PX over a burst.
        """
        step_deg = self.scene.sim.eye.torsion_deg_per_s * self.scene.spec.camera.exposure_s
        edge_px = np.radians(STEPS * abs(step_deg)) * self.scene.half_field_deg * self.scene.geometry.px_per_deg
        return step_deg if edge_px >= MIN_DRIFT_PX else 0.0

    @property
    def moves(self) -> bool:
        """Whether the retina moves between the frames of a burst."""
        return self.drift_px != 0 or self.torsion_deg != 0

    def parts(self, exposure_s: float) -> int:
        """Return how many exposures of this length fit into one of a picture, 1 to MAX_PARTS; 1 for a still eye."""
        if not (self.moves or self.scene.sim.eye.drift_deg_per_s):
            return 1
        return min(max(1, round(self.scene.spec.camera.exposure_s / exposure_s)), MAX_PARTS)

    def render_burst(self, eye: Eye, exposure_s: float) -> None:
        """Compute the light of an eye in the picture's colour for each frame of a burst of exposures of this length."""
        parts = self.parts(exposure_s)
        for step in range((STEPS + 1) * parts if self.moves else 1):
            self.electrons_per_s(eye, self.scene.spec.light.colour, step, parts)

    def electrons_per_s(self, eye: Eye, colour: Colour, step: int = 0, parts: int = 1) -> Image:
        """Return the noise-free electrons per second of an eye with one colour at full drive, float32 (rows, cols).

        `step` is the index of the frame, and the number of frames for which the eye has drifted and turned before it;
        the motion repeats after (STEPS + 1) * `parts` frames. A frame lasts for 1 / `parts` of a picture's exposure.
        Computed once for each combination. Behind a white card no eye is seen.
        """
        if self._shows_card:
            return _of_card(self.retina(eye).plane(colour), self._of_eye_e_per_s(eye, colour))
        return self._of_eye_e_per_s(eye, colour, step, parts)

    def _of_eye_e_per_s(self, eye: Eye, colour: Colour, step: int = 0, parts: int = 1) -> Image:
        step %= (STEPS + 1) * parts
        key = eye, colour, step, parts, self.turn_deg
        if key not in self._rates:
            setup = self.setup(eye, colour)
            if step > 0 or parts > 1:
                scene = setup.scene  # of the middle of the frame, like the blur
                exposures = (step + 0.5) / parts - 0.5
                radius_px = scene.geometry.px_per_deg * lit_deg(scene, self.plan) / 2
                away_px = (0.0, exposures * self.drift_px)
                turn_deg = exposures * self.torsion_deg
                moved = moved_behind_field(self.retina(eye), away_px, radius_px, turn_deg)
                setup = build_setup(scene, moved, self._chosen(scene))
                setup.drift_px = setup.drift_px[0] / parts, setup.drift_px[1] / parts
            self._rates[key] = electrons_per_s(setup)
        return self._rates[key]

    def _chosen(self, scene: Scene) -> tuple[Decision, ...]:
        planned = scene.colour == self.scene.spec.light.colour and scene.turn_deg == STRAIGHT
        return self.plan if planned else self._choose(scene)


def lit_deg(scene: Scene, plan: Sequence[Decision]) -> float:
    """Return the full angle beyond which no light arrives, degrees: the field's, wider if the penumbra is simulated."""
    soft = any(decision.simulated and decision.name == Penumbra.name for decision in plan)
    return scene.lit_deg if soft else scene.optics.field_deg


def _of_card(reflectance: Image, light: Image) -> Image:
    """Return the light of paper in place of an eye with this reflectance; far from any focus it is even."""
    gain = PAPER_REFLECTANCE / float(reflectance[reflectance > 0].mean(dtype=np.float64))
    return np.full_like(light, gain * float(light.mean(dtype=np.float64)))
