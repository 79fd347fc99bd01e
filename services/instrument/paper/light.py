"""L: the light that a human eye gives with each shipped head, and a picture at that light.

The light is the head's own budget (`diffuscope optics`): its mean over the disc d + 2s that the field lights on the
sensor. The brightest pixel comes from a rendered frame, whose peak over that mean depends on caustic and retina.
"""

from collections.abc import Iterable
from math import pi
from typing import Any, NamedTuple

from device.clock import VirtualClock
from device.optics.budget import optical_budget
from device.sim.render import blurred, psf
from device.sim.world import World
from device.spec import InstrumentSpec, load_head
from device.values import Image
from services import resources
from services.instrument.optics import design
from services.instrument.paper.bench import SCENES, Bench, Take, changed
from services.instrument.paper.outcome import Experiment, Outcome, Sheet, above, within
from services.instrument.paper.pictures import plane, side_by_side

SCENE, HEAD = "human_eye_imx296", "imx296"
OF_SCENES_E = 15000.0  # the brightest pixel of sim.toml and of most scenes
NEARLY_FULL_E = 8000.0  # of the 10000 that a pixel of the IMX296 holds
HUMAN_EYE = {"sim.eye.shown_by": "human eye", "sim.eye.focal_length_um": 17000.0}
PIXEL_UM = 5.0  # smaller pixels are merged until they are this wide: the peak over the mean hardly changes
FILE = "human-eye.png"
NOTE = (
    "The light is a budget, right within a factor of two (nobody measured the LEDs), with the quantum efficiency "
    "of the paper's sensor. The other pictures on this page have 7000 to 20 000 electrons in their brightest pixel: "
    "they show what the optics can do, not what a human eye gives in one exposure. In its light the fine vessels are "
    "broken, and the prior for few edges leaves even patches between them."
)


class HumanLight(NamedTuple):
    """Electrons in one exposure of a human eye by a head: the mean of the lit disc, and the brightest pixel."""

    head: str
    exposure_s: float
    mean_e: float
    peak_e: float


def peak_over_mean(spec: InstrumentSpec) -> float:
    """The brightest pixel of a simulated head's frame, over the mean of the disc d + 2s, without noise."""
    world = World(spec, VirtualClock())
    setup = world.setup(spec.light.colour)
    point = psf(setup)
    arriving = blurred([(setup.object, point)], setup.shape)
    optics, sensor_um = world.optics, spec.camera.pitch_um
    shift_um = optics.diffuser_to_sensor_um * optics.angular_magnification * optics.field_deg * pi / 180
    disc_px = pi * ((optics.iris_um + shift_um) / 2 / sensor_um) ** 2
    return float(arriving.max()) * disc_px / (float(setup.object.sum()) * float(point.sum()))


def human_light(name: str) -> HumanLight:
    """The light of a human eye with a shipped head, by its file's name without the ending."""
    path = resources.HEADS / f"{name}.toml"
    spec = load_head(path)
    mean_e = optical_budget(design(path, None, None, None)).electrons_per_px
    n = max(1, round(PIXEL_UM / spec.camera.pitch_um))
    camera = {"camera.rows": spec.camera.rows // n, "camera.cols": spec.camera.cols // n,
              "camera.pitch_um": n * spec.camera.pitch_um}  # fmt: skip
    ratio = peak_over_mean(changed(spec, camera | HUMAN_EYE))
    return HumanLight(spec.name, spec.camera.exposure_s, mean_e, mean_e * ratio)


def shipped_heads() -> list[str]:
    """The names of the head files, without their ending."""
    return sorted(path.stem for path in resources.HEADS.glob("*.toml"))


def on_the_simulated_head() -> dict[str, Any]:
    """The changes that put the scene's eye before the simulated head, in the light of the other scenes."""
    spec = load_head(resources.HEADS / "sim.toml")
    keys = ("rows", "cols", "pitch_um", "bit_depth", "black_dn", "full_well_e", "read_noise_e")
    return {f"camera.{key}": getattr(spec.camera, key) for key in keys} | {"sim.peak_e": OF_SCENES_E}


def run_light(bench: Bench) -> Outcome:
    """Each head's light; and one eye in that of the IMX296 head, beside the light of the other scenes."""
    bench.say("L: the light of a human eye")
    lights = {name: human_light(name) for name in shipped_heads()}
    bright, human = bench.take(SCENE, on_the_simulated_head()), bench.take(SCENE)
    takes = {
        "simulated head": bright, "IMX296 head, well nearly full": bench.take(SCENE, {"sim.peak_e": NEARLY_FULL_E}),
        "IMX296 head, a human eye's light": human,
    }  # fmt: skip
    pictures = {name: bench.solve(take, "variation") for name, take in takes.items()}
    scene_e = _peak_e(load_head(SCENES / f"{SCENE}.toml"))
    pcc = human.score(pictures["IMX296 head, a human eye's light"]).pcc
    claims = (
        within("peak of the scene over that of the IMX296 head's budget", scene_e / lights[HEAD].peak_e, 0.9, 1.1),
        above("PCC of our default in that light", pcc, 0.85),
    )
    first, *_, last = ((pictures[name], take.inside) for name, take in takes.items())
    pair = f"left: {OF_SCENES_E:.0f} e- in the brightest pixel; right: {scene_e:.0f}, a human eye and the IMX296 head"
    shown = (plane("truth", bright.truth, bright.inside), side_by_side(pair, FILE, (first, last)))
    peaks_e = (OF_SCENES_E, NEARLY_FULL_E, scene_e)
    rows = tuple(
        _row(name, peak_e, take, pictures[name]) for (name, take), peak_e in zip(takes.items(), peaks_e, strict=True)
    )
    scores = Sheet(("light", "brightest pixel, e-", "PCC", "detail", "vessel contrast", "of the truth"), rows)
    return Outcome(claims, shown, (_heads(lights.values()), scores), (NOTE,))


def _peak_e(spec: InstrumentSpec) -> float:
    assert spec.sim is not None
    return spec.sim.peak_e


def _heads(lights: Iterable[HumanLight]) -> Sheet:
    rows = tuple((one.head, f"{one.mean_e:.0f}", f"{one.peak_e:.0f}", f"{1000 * one.exposure_s:g}") for one in lights)
    return Sheet(("head", "mean of the lit disc, e-", "brightest pixel, e-", "exposure, ms"), rows)


def _row(name: str, peak_e: float, take: Take, picture: Image) -> tuple[str, ...]:
    scores, contrast = take.score(picture), take.judge.truth_contrast
    assert scores.vessel_contrast is not None
    assert contrast is not None
    return (name, f"{peak_e:.0f}", f"{scores.pcc:.3f}", f"{scores.highpass_pcc:.3f}", f"{scores.vessel_contrast:.3f}",
            f"{contrast:.3f}")  # fmt: skip


EXPERIMENTS = (
    Experiment(
        "L", "The light of a human eye",
        "How many electrons a human fundus gives with each shipped head at full drive, and what a picture is then.",
        "Not in the paper, which shows screens, prints and model eyes.", run_light,
    ),
)  # fmt: skip
