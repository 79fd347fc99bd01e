"""L: the light of a human eye with each shipped head, and a picture in that light.

The light is the head's optical budget (`diffuscope optics`): the mean over the lit disc on the sensor, of diameter
d + 2s (d: iris, s: shift of the field edge). The brightest pixel comes from a rendered frame, whose ratio of peak to
mean depends on caustic and retina.
"""

from collections.abc import Iterable
from math import pi
from typing import NamedTuple

from device.clock import VirtualClock
from device.config.head_file import InstrumentSpec, load_head
from device.optics.budget import optical_budget
from device.sim.render import convolved, psf
from device.sim.world import World
from device.values import Image
from services import resources
from services.lab.optics_report import design
from services.lab.paper.bench import SCENES, Bench, HeadChanges, SimulatedFrame, with_changes
from services.lab.paper.outcome import Experiment, Outcome, Table, above, within
from services.lab.paper.pictures import plane, side_by_side

SCENE, HEAD = "human_eye_imx296", "imx296"
OF_SCENES_E = 15000.0  # electrons in the brightest pixel of sim.toml and of most scenes
NEARLY_FULL_E = 8000.0  # of a full well of 10000 e- of the IMX296
HUMAN_EYE: HeadChanges = {"sim.eye.shown_by": "human eye", "sim.eye.focal_length_um": 17000.0}
PIXEL_UM = 5.0  # smaller pixels are merged up to this width; the ratio of peak to mean hardly changes
FILE = "human-eye.png"
NOTE = (
    "The light is a budget, right within a factor of two (the LEDs were not measured), with the quantum efficiency "
    "of the paper's sensor. The other pictures on this page have 7000 to 20 000 electrons in their brightest pixel: "
    "they show what the optics can do, not what a human eye gives in one exposure. In its light the fine vessels are "
    "broken, and the prior for few edges leaves even patches between them."
)


class HumanLight(NamedTuple):
    """Electrons in one exposure of a human eye by a head: mean of the lit disc, and brightest pixel."""

    head: str
    exposure_s: float
    mean_e: float
    peak_e: float


def peak_over_mean(spec: InstrumentSpec) -> float:
    """Return the ratio of the brightest pixel of a noise-free frame to the mean of the lit disc of diameter d + 2s."""
    world = World(spec, VirtualClock())
    setup = world.setup(spec.light.colour)
    point = psf(setup)
    arriving = convolved([(setup.object, point)], setup.shape)
    optics, sensor_um = world.scene.optics, spec.camera.pitch_um
    shift_um = optics.diffuser_to_sensor_um * optics.angular_magnification * optics.field_deg * pi / 180
    disc_px = pi * ((optics.iris_um + shift_um) / 2 / sensor_um) ** 2
    return float(arriving.max()) * disc_px / (float(setup.object.sum()) * float(point.sum()))


def human_light(name: str) -> HumanLight:
    """Return the light of a human eye with a shipped head; `name` is that of the head file without extension."""
    path = resources.HEADS / f"{name}.toml"
    spec = load_head(path)
    mean_e = optical_budget(design(path, None, None, None)).electrons_per_px
    n = max(1, round(PIXEL_UM / spec.camera.pitch_um))
    camera = {"camera.rows": spec.camera.rows // n, "camera.cols": spec.camera.cols // n,
              "camera.pitch_um": n * spec.camera.pitch_um}  # fmt: skip
    ratio = peak_over_mean(with_changes(spec, {**camera, **HUMAN_EYE}))
    return HumanLight(spec.name, spec.camera.exposure_s, mean_e, mean_e * ratio)


def shipped_heads() -> list[str]:
    """Return the names of the head files without extension, without those that have no lamp."""
    return sorted(path.stem for path in resources.HEADS.glob("*.toml") if load_head(path).light.backend != "none")


def simulated_head_changes() -> HeadChanges:
    """Return the changes that place the scene's eye before the simulated head, with OF_SCENES_E electrons."""
    camera = load_head(resources.HEADS / "sim.toml").camera
    return {
        "camera.rows": camera.rows, "camera.cols": camera.cols, "camera.pitch_um": camera.pitch_um,
        "camera.bit_depth": camera.bit_depth, "camera.black_dn": camera.black_dn,
        "camera.full_well_e": camera.full_well_e, "camera.read_noise_e": camera.read_noise_e,
        "sim.peak_e": OF_SCENES_E,
    }  # fmt: skip


def run_light(bench: Bench) -> Outcome:
    """Compute the light of each head, and solve one eye at three levels: other scenes, well nearly full, human eye."""
    bench.progress("L: the light of a human eye")
    lights = {name: human_light(name) for name in shipped_heads()}
    bright, human = bench.expose(SCENE, simulated_head_changes()), bench.expose(SCENE)
    takes = {
        "simulated head": bright, "IMX296 head, well nearly full": bench.expose(SCENE, {"sim.peak_e": NEARLY_FULL_E}),
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
    scores = Table(("light", "brightest pixel, e-", "PCC", "detail", "vessel contrast", "of the truth"), rows)
    return Outcome(claims, shown, (_heads(lights.values()), scores), (NOTE,))


def _peak_e(spec: InstrumentSpec) -> float:
    assert spec.sim is not None
    return spec.sim.peak_e


def _heads(lights: Iterable[HumanLight]) -> Table:
    rows = tuple((one.head, f"{one.mean_e:.0f}", f"{one.peak_e:.0f}", f"{1000 * one.exposure_s:g}") for one in lights)
    return Table(("head", "mean of the lit disc, e-", "brightest pixel, e-", "exposure, ms"), rows)


def _row(name: str, peak_e: float, take: SimulatedFrame, picture: Image) -> tuple[str, ...]:
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
