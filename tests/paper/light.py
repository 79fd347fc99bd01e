"""L: the light of a human eye with each shipped head, and its picture in that light beside one in bright light.

The light is that of the scenes `human_eye_*`, `peak_e = "budget"`: the light budget of the head's LEDs (`diffuscope
optics --light`) as the mean over the lit disc on the sensor, of diameter d + 2s (d: iris, s: shift of the field edge).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from device.config.head_file import CameraSpec, load_head
from device.sim.optical_setup import Scene
from device.user_files import files_in
from device.values import Image
from services import resources
from tests.paper.bench import SCENES, Bench, SimulatedFrame
from tests.paper.outcome import Claim, Experiment, Figure, Outcome, Table, above, below
from tests.paper.pictures import plane, side_by_side

BRIGHT_SHARE = 15000 / 23000  # of the full well, in the brightest pixel: the light of sim.toml
WEAK, STRONG = "imx296", "imx296_power"  # one sensor in the light of two rings
SEEN_PCC = {  # the smaller of full and merged pixels; the high-power ring's truth has its soft edge, which adds to it
    "imx296": 0.893,
    "imx296_power": 0.980,
    "imx477": 0.895,
    "paper": 0.912,
    "sim": 0.908,
}
SLACK = 0.01  # tolerance of a PCC below the measured one
FILE, HEADS_FILE, ELEMENTS_FILE = "human-eye.png", "heads-eye.png", "elements-eye.png"
ELEMENTS = {WEAK: "diffuser", "imx296_lenslets": "22 lenslets", "imx296_control": "one lens behind a stop"}  # one ring
NOTE = (
    "The light is a budget, right within a factor of 2.5 in 90 % (nothing was measured), with the quantum efficiency "
    "of the paper's sensor. The other pictures on this page have 7000 to 20 000 electrons in their brightest pixel: "
    "they show what the optics can do, not what a human eye gives in one exposure. In the light of the LuMini's LEDs "
    "the fine vessels are lost, and the prior for few edges leaves even patches between the others. The high-power "
    "ring gives ten times that light on the same sensor."
)


class HumanLight(NamedTuple):
    """Electrons in one exposure of a human eye by a head: mean of the lit disc, and about the brightest pixel."""

    head: str
    exposure_s: float
    mean_e: float
    peak_e: float

    @property
    def short_name(self) -> str:
        """Name of the head without what is simulated in it."""
        return self.head.split(",")[0]


class HeadPictures(NamedTuple):
    """Pictures of one eye by one head: the frame in the eye's own light, and both pictures, on the scores' samples."""

    light: HumanLight
    take: SimulatedFrame
    human: Image
    bright: Image


def human_light(name: str) -> HumanLight:
    """Return the light of a human eye with a shipped head; `name` is that of the head file without extension."""
    spec = load_head(SCENES / f"human_eye_{name}.toml")
    scene = Scene(spec, spec.light.colour)
    assert scene.budget is not None
    head = load_head(resources.HEADS / f"{name}.toml")
    return HumanLight(head.name, spec.camera.exposure_s, scene.budget.mean_e, scene.peak_e)


def shipped_heads() -> list[str]:
    """Return the names of the head files with a lamp and a diffuser, without extension, and without their copies."""
    paths = files_in(resources.HEADS, "*.toml")
    heads = {path.stem: load_head(path) for path in paths if not path.stem.startswith("sim_")}
    lit = {name: head.optics for name, head in heads.items() if head.light.backend != "none"}
    return [name for name, optics in lit.items() if optics is None or optics.element.kind == "diffuser"]


def head_pictures(bench: Bench, names: Sequence[str]) -> dict[str, HeadPictures]:
    """Return the pictures of each head; heads with the same sensor share the one in bright light."""
    bright: dict[tuple[float, ...], Image] = {}
    found = {}
    for name in names:
        bench.progress(f"L: a human eye with {name}")
        scene = f"human_eye_{name}"
        take = bench.expose(scene)
        camera = bench.scene(scene).camera
        if _sensor(camera) not in bright:
            level_e = BRIGHT_SHARE * camera.full_well_e / bench.merged**2
            bright[_sensor(camera)] = bench.solve(bench.expose(scene, {"sim.peak_e": level_e}), "variation")
        human = bench.solve(take, "variation")
        found[name] = HeadPictures(human_light(name), take, human, bright[_sensor(camera)])
    return found


def _sensor(camera: CameraSpec) -> tuple[float, ...]:
    return (
        camera.rows,
        camera.cols,
        camera.pitch_um,
        camera.bit_depth,
        camera.black_dn,
        camera.full_well_e,
        camera.read_noise_e,
        camera.exposure_s,
    )


def element_pictures(bench: Bench) -> tuple[Figure, tuple[Claim, ...]]:
    """Return truth and default picture behind each element in the light of one ring, and what lenslets promise."""
    takes = {name: bench.expose(f"human_eye_{name}") for name in ELEMENTS}
    made = {name: bench.solve_default(take) for name, take in takes.items()}
    detail = {name: takes[name].score(picture).highpass_pcc for name, (picture, _) in made.items()}
    first = takes[WEAK]
    words = "a human eye: truth; " + "; ".join(
        f"{element}, detail {detail[name]:.2f}" for name, element in ELEMENTS.items()
    )
    tiles = [(first.truth, first.inside), *((picture, takes[name].inside) for name, (picture, _) in made.items())]
    gain = detail["imx296_lenslets"] - detail[WEAK]
    sphere = made["imx296_lenslets"][1].refraction_dpt["sphere"]
    assert sphere is not None, "the frame gives the refraction"
    claims = (
        above("detail behind lenslets minus that behind the diffuser", gain, 0.0).limit_from("better"),
        below("|mean sphere| of an eye without refraction, behind lenslets, dpt", abs(float(sphere)), 0.1),
    )
    return side_by_side(words, ELEMENTS_FILE, tiles), claims


def run_light(bench: Bench) -> Outcome:
    """Solve one eye with each head at the eye's own light and in bright light."""
    found = head_pictures(bench, shipped_heads())
    weak, strong = found[WEAK], found[STRONG]
    contrasts = [_contrast(pictures.take, pictures.human) for pictures in (weak, strong)]
    claims: list[Claim] = [
        above(
            f"PCC, {pictures.light.short_name}",
            pictures.take.score(pictures.human).pcc,
            round(SEEN_PCC[name] - SLACK, 3),
        )
        for name, pictures in found.items()
    ]
    claims.append(
        above(
            "vessel contrast with the high-power ring over that with the LuMini",
            contrasts[1] / contrasts[0],
            1.0,
            digits=2,
        ).limit_from("five times the light cannot show less")
    )
    shown = [figure for pictures in found.values() for figure in _row(pictures)]
    first, second = weak.light.mean_e, strong.light.mean_e
    words = (
        f"truth; bright light; a human eye: {weak.light.short_name} ({first:.0f} e- a pixel), "
        f"{strong.light.short_name} ({second:.0f} e-)"
    )
    tiles = (weak.take.truth, weak.bright, weak.human, strong.human)
    shown.append(side_by_side(words, FILE, [(tile, weak.take.inside) for tile in tiles]))
    heads = "a human eye: " + ", ".join(f"{x.light.short_name} ({x.light.mean_e:.0f} e-)" for x in found.values())
    same_field = {STRONG: weak.take.inside}  # of the same sensor, without the penumbra around it: one scale for all
    fields = [(pictures.human, same_field.get(name, pictures.take.inside)) for name, pictures in found.items()]
    shown.append(side_by_side(heads, HEADS_FILE, fields))
    elements, promised = element_pictures(bench)
    return Outcome((*claims, *promised), (*shown, elements), (_table(found),), (NOTE,))


def _contrast(take: SimulatedFrame, picture: Image) -> float:
    contrast = take.score(picture).vessel_contrast
    assert contrast is not None
    return contrast


def _row(pictures: HeadPictures) -> list[Figure]:
    """Return the row of pictures of one head: truth, bright light, the eye's own light."""
    name, take, inside = pictures.light.short_name, pictures.take, pictures.take.inside
    lights = {
        "bright light": pictures.bright,
        f"a human eye's light, {pictures.light.mean_e:.0f} e- a pixel": pictures.human,
    }
    figures = [replace(plane(f"{name}: truth", take.truth, inside), begins=True)]
    for words, picture in lights.items():
        caption = f"{name}: {words}: PCC {take.score(picture).pcc:.3f}, vessel contrast {_contrast(take, picture):.3f}"
        figures.append(plane(caption, picture, inside))
    return figures


def _table(found: dict[str, HeadPictures]) -> Table:
    rows = []
    for pictures in found.values():
        light, take, contrast = pictures.light, pictures.take, pictures.take.judge.truth_contrast
        assert contrast is not None
        rows.append(
            (
                light.head,
                f"{light.mean_e:.0f}",
                f"{light.peak_e:.0f}",
                f"{1000 * light.exposure_s:g}",
                *(f"{take.score(picture).pcc:.3f}" for picture in (pictures.human, pictures.bright)),
                *(f"{_contrast(take, picture):.3f}" for picture in (pictures.human, pictures.bright)),
                f"{contrast:.3f}",
            )
        )
    head = (
        "head",
        "mean of the lit disc, e-",
        "brightest pixel, about, e-",
        "exposure, ms",
        "PCC",
        "in bright light",
        "vessel contrast",
        "in bright light",
        "of the truth",
    )
    return Table(head, tuple(rows))


EXPERIMENTS = (
    Experiment(
        "L",
        "The light of a human eye",
        "How many electrons a human fundus gives with each shipped head at full drive, and what a picture is then, "
        "beside one in bright light (0.65 of the full well in the brightest pixel).",
        "Not in the paper, which shows screens, prints and model eyes.",
        run_light,
    ),
)
