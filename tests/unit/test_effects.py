"""Every effect by itself: nothing at its default, more with its key, and what it does where it is strong."""

import re
from math import asin, degrees, pi

import numpy as np
import pytest

from device.errors import SettingError, SpecError
from device.optics.diffuser import Refraction
from device.recon.geometry import Grid
from device.recon.prepare import Preparer
from device.sim.calibrate import simulated_calibration
from device.sim.effects import EFFECTS
from device.sim.effects.curvature import curvature_dpt
from device.sim.effects.hot import hot_pixels
from device.sim.effects.leds import EMITTER_MM, leds_mm, lit_share
from device.sim.effects.reflex import reflex_deg, spots
from device.sim.fundus import Fundus
from device.sim.plan import Decision, decide, prepared, table
from device.sim.render import electrons_per_s, psf
from device.sim.setup import Scene, Setup, Size
from device.sim.world import World
from device.spec import ChainSpec, InstrumentSpec, load_head
from tests.simulated import SCENES, coarse, expected, exposed, having, world

PLAIN = having(coarse(load_head(SCENES / "healthy.toml"), 4), peak_e=15000.0)
CORE = ("shot", "read", "quantisation")
MOVING = {"eye": {"drift_deg_per_s": 1.0}}
CORNEA = {"eye": {"shown_by": "human eye"}, "light": {"ring_um": 4500.0}}

KEYS = [  # effect, table, key, growing values, what else the scene needs for it
    ("falloff", "light", "falloff", (False, True), {}),
    ("reflex", "light", "polariser_leak", (0.0, 1e-4, 1e-3), CORNEA),
    ("leds", "light", "ring_offset_um", (0.0, 1500.0, 3000.0), {}),
    ("leds", "light", "ring_offset_um", (0.0, -1500.0, -3000.0), {"light": {"dead_led": 3}}),
    ("stray", "light", "stray", (0.0, 1e-3, 0.1), {}),
    ("ambient", "light", "ambient", (0.0, 1e-3, 0.1), {}),
    ("refraction", "eye", "m_dpt", (0.0, 0.1, 1.0, 5.0), {}),
    ("refraction", "eye", "m_dpt", (0.0, -0.1, -5.0), {}),
    ("refraction", "eye", "j45_dpt", (0.0, 0.5, 1.0), {}),
    ("curvature", "eye", "surface", ("curved", "flat"), {}),
    ("pupil", "eye", "decentred_um", (0.0, 3000.0, 4000.0), {}),
    ("pupil", "eye", "axial_um", (0.0, -10000.0, -20000.0), {"eye": {"pupil_um": 5000.0}}),
    ("motion", "eye", "drift_deg_per_s", (0.0, 0.5, 5.0), {}),
    ("shutter", "sensor", "line_s", (0.0, 1e-5, 1e-4), MOVING),
    ("shutter", "eye", "drift_deg_per_s", (0.0, 1.0, 10.0), {"sensor": {"line_s": 1e-5}}),
    ("prnu", "sensor", "prnu", (0.0, 1e-3, 0.1), {}),
    ("bayer", "sensor", "bayer", (False, True), {}),
    ("dark", "sensor", "dark_e_per_s", (0.0, 10.0, 1000.0), {}),
    ("dsnu", "sensor", "dsnu_e", (0.0, 1.0, 100.0), {}),
    ("hot", "sensor", "hot_pixels", (0.0, 1e-4, 1e-2), {}),
    ("nonlinearity", "sensor", "nonlinearity", (0.0, 1e-3, 0.1), {}),
    ("nonlinearity", "sensor", "nonlinearity", (0.0, -1e-3, -0.1), {}),
    ("source", "calibration", "source_um", (0.0, 50.0, 275.0), {}),
]
ALWAYS = {"shot", "read", "quantisation", "bandwidth"}  # what every sensor and every LED has


def effect_named(name: str):
    return next(effect for effect in EFFECTS if effect.name == name)


def scene(spec: InstrumentSpec) -> Scene:
    return Scene(spec, spec.light.colour)


def alone(spec: InstrumentSpec, *names: str) -> World:
    return world(spec, only=names or ("leds",))  # which change nothing: no noise either


@pytest.mark.parametrize(("name", "where", "key", "values", "also"), KEYS)
def test_a_size_is_zero_at_the_default_and_grows_with_its_key(name, where, key, values, also) -> None:
    spec = having(PLAIN, **also)
    assert getattr(getattr(PLAIN.sim, where), key) == values[0], "the first value is the default"
    sizes = [effect_named(name).size(scene(having(spec, **{where: {key: value}}))).eta for value in values]
    assert sizes[0] == 0
    assert sizes == sorted(sizes)
    assert sizes[-1] > sizes[0]


@pytest.mark.parametrize("name", [effect.name for effect in EFFECTS if effect.name not in ALWAYS])
def test_at_its_default_an_effect_is_exactly_nothing(name: str) -> None:
    assert effect_named(name).size(scene(PLAIN)).eta == 0
    without, with_it = (exposed(alone(PLAIN, *CORE, *more)) for more in ((), (name,)))
    if name in ("curvature", "pupil"):  # the same caustic in 25 parts: single precision may turn a draw
        assert (without != with_it).mean() < 0.01
        assert (np.abs(without.astype(int) - with_it) > 1).mean() < 1e-4
    else:
        assert np.array_equal(without, with_it)


def test_colours_differ_and_green_is_what_is_drawn() -> None:
    sizes = [effect_named("tint").size(Scene(PLAIN, colour)).eta for colour in ("green", "blue", "red")]
    assert sizes[0] == 0
    assert sizes == sorted(sizes)
    dots = having(PLAIN, object={"kind": "dots"})
    assert effect_named("tint").size(Scene(dots, "red")).eta == 0


def point_passes(angle_deg: float, turn: float) -> float:
    """The share of a point's light that passes the iris, with the walk of the paper's relay."""
    at_deg = (angle_deg * np.cos(turn), angle_deg * np.sin(turn))
    spec = having(PLAIN, object={"kind": "point", "at_deg": at_deg}, eye={"walks": True})
    setup = Setup(scene(spec), world(PLAIN).retina, world(PLAIN).sensor)
    effect_named("pupil").apply(setup)
    return float(psf(setup, at_deg).sum(dtype=np.float64))


@pytest.mark.parametrize("turn", [0.0, 2.2])
@pytest.mark.parametrize(
    ("angle_deg", "share"), [(15, 1.0), (25, 1.0), (26, 0.879), (28, 0.458), (30, 0.063), (31, 0.0)]
)
def test_the_beam_walks_off_the_iris_as_the_paper_measured(angle_deg: float, share: float, turn: float) -> None:
    assert point_passes(angle_deg, turn) == pytest.approx(share, abs=0.002)  # scene S8; optics.md 1.4


def dot(spec: InstrumentSpec, *names: str, at_px: tuple[int, int] = (0, 0)) -> tuple[Setup, np.ndarray]:
    """One bright pixel, right and down of the middle, through the named effects."""
    here = scene(spec)
    plane = np.zeros((133, 133), np.float32)
    plane[66 + at_px[1], 66 + at_px[0]] = 1
    chosen = [one for one in decide(here, only=names) if one.simulated]
    setup = prepared(here, Fundus(dict.fromkeys(("red", "green", "blue"), plane), plane > 0), chosen)
    return setup, electrons_per_s(setup).astype(np.float64)


def centroid(image: np.ndarray) -> tuple[float, float]:
    """(right, down)."""
    rows, cols = np.indices(image.shape)
    return float((cols * image).sum() / image.sum()), float((rows * image).sum() / image.sum())


def spread(image: np.ndarray) -> tuple[float, float]:
    """Variance along the columns and along the rows, in pixels."""
    rows, cols = np.indices(image.shape)
    right, down = centroid(image)
    weight = image / image.sum()
    return float(((cols - right) ** 2 * weight).sum()), float(((rows - down) ** 2 * weight).sum())


def test_a_drift_smears_along_its_way_and_loses_no_light() -> None:
    spec = having(PLAIN, eye={"drift_deg_per_s": 60.0})
    still, moved = dot(spec, "shot")[1], dot(spec, "motion")[1]
    way_px = 60.0 * spec.camera.exposure_s * scene(spec).geometry.px_per_deg
    wider = np.subtract(spread(moved), spread(still))
    assert wider == pytest.approx((way_px**2 / 12, 0), abs=1.5)  # the variance of an even smear: 45 px2
    assert centroid(moved) == pytest.approx(centroid(still), abs=0.02)


def test_a_drift_brings_nothing_round_from_the_other_side() -> None:
    spec = having(PLAIN, eye={"drift_deg_per_s": 120.0})  # a saccade: 47 pixels
    _, image = dot(spec, "motion", at_px=(60, 0))
    assert image[:, :150].max() < 1e-3 * image.max()


def test_a_rolling_shutter_skews() -> None:
    spec = having(PLAIN, eye={"drift_deg_per_s": 50.0}, sensor={"line_s": 1e-4})
    lag_px = 50.0 * 1e-4 * scene(spec).geometry.px_per_deg
    moved = []
    for down in (-60, 60):
        still, skewed = (dot(spec, name, at_px=(0, down))[1] for name in ("shot", "shutter"))
        moved.append(centroid(skewed)[0] - centroid(still)[0])
    assert moved == pytest.approx([-60 * lag_px, 60 * lag_px], abs=0.2)


def test_a_rolling_shutter_wraps_nothing_round_the_edge() -> None:
    spec = having(PLAIN, eye={"drift_deg_per_s": 200.0}, sensor={"line_s": 1e-3})
    narrow = spec.model_copy(update={"camera": spec.camera.model_copy(update={"cols": 240})})
    wide_image, image = (expected(alone(head, "shutter")) for head in (spec, narrow))
    both = [frame / frame[135].max() for frame in (wide_image[:, 120:360], image)]
    assert both[0] == pytest.approx(both[1], abs=2e-3)


def test_short_sight_shrinks_the_caustic_and_keeps_its_light() -> None:
    spec = having(PLAIN, eye={"m_dpt": 8.0})
    relaxed, myope = (dot(spec, name)[1] for name in ("shot", "refraction"))
    scale = 1 - scene(spec).geometry.scale_per_dpt * 8.0
    assert np.sqrt(spread(myope)[0] / spread(relaxed)[0]) == pytest.approx(scale, abs=0.003)


def test_a_flat_screen_is_short_sighted_at_its_edge() -> None:
    """optics.md 3.4: 12 mm on a flat screen behind a 25 mm lens."""
    here = scene(having(PLAIN, eye={"surface": "flat"}))
    at_12_mm = curvature_dpt(here, degrees(np.arctan(12 / 25)))
    assert at_12_mm == pytest.approx((7.7, 16.9), abs=0.1)
    assert curvature_dpt(here, degrees(np.arctan(7.5 / 25))) == pytest.approx((3.0, 6.6), abs=0.05)
    setup = Setup(here, world(PLAIN).retina, world(PLAIN).sensor)
    effect_named("curvature").apply(setup)
    right, down = (setup.aberrations["curvature"](place) for place in ((16.0, 0.0), (0.0, 16.0)))
    assert right == pytest.approx(Refraction(down.m_dpt, -down.j0_dpt, 0.0), abs=1e-9)
    assert right.j0_dpt > 0, "the tangential meridian is the stronger one, and lies along the radius"


@pytest.mark.parametrize(("ring_um", "angle_deg"), [(4533.3, 8.5), (5973.3, 16.7)])
def test_the_reflex_stands_where_the_cornea_mirrors_it(ring_um: float, angle_deg: float) -> None:
    """optics.md 3.6: a ring of 1.7 mm at the pupil stands at 8.5 degrees, one of 2.24 mm at the field's edge."""
    here = scene(having(PLAIN, eye={"shown_by": "human eye"}, light={"ring_um": ring_um, "polariser_leak": 1e-3}))
    ring_mm = ring_um / 2000 * 0.75
    assert reflex_deg(here) == pytest.approx(2 * degrees(asin(ring_mm / 7.8)) - 16.7, abs=1e-9)
    assert reflex_deg(here) == pytest.approx(angle_deg, abs=0.05)
    image = spots(here, (700, 700))
    away_px, sigma_px = reflex_deg(here) * here.geometry.px_per_deg, 800 / PLAIN.camera.pitch_um
    assert spread(image) == pytest.approx((away_px**2 / 2 + sigma_px**2,) * 2, rel=0.01)  # blobs on a ring
    assert image.sum() == pytest.approx(12 * 2 * pi * sigma_px**2, rel=0.01)


def test_a_reflex_beside_the_field_is_nothing_and_one_inside_is_light() -> None:
    outside = having(PLAIN, eye={"shown_by": "human eye"}, light={"ring_um": 9500.0, "polariser_leak": 1e-2})
    assert effect_named("reflex").size(scene(outside)).eta == 0
    assert np.array_equal(expected(alone(outside, "reflex")), expected(alone(outside)))
    inside = having(outside, light={"ring_um": 4500.0})
    assert (expected(alone(inside, "reflex")) - expected(alone(inside))).mean() > 0


def test_stray_light_needs_the_lamp_and_the_rooms_does_not() -> None:
    spec = having(PLAIN, light={"stray": 0.1, "ambient": 0.2})
    black, gain = spec.camera.black_dn, spec.camera.gain_e_per_dn
    lit = expected(alone(spec))
    mean_e = lit[lit > 0.05 * lit.max()].mean()
    dark = {name: (exposed(alone(spec, name), lit=False) - black).mean() * gain for name in ("stray", "ambient")}
    assert dark == pytest.approx({"stray": 0.0, "ambient": 0.2 * mean_e}, rel=0.01)
    for name, share in (("stray", 0.1), ("ambient", 0.2)):
        more = expected(alone(spec, name)) - lit
        assert more == pytest.approx(np.full_like(more, share * mean_e), rel=0.01, abs=2)


def test_dark_current_is_there_without_light() -> None:
    spec = having(PLAIN, sensor={"dark_e_per_s": 30000.0})
    dark = (exposed(alone(spec, "dark"), lit=False) - spec.camera.black_dn).mean() * spec.camera.gain_e_per_dn
    assert dark == pytest.approx(3000.0, rel=0.01)


def test_light_falls_off_with_the_fourth_power_of_the_cosine() -> None:
    spec = having(PLAIN, light={"falloff": True})
    even, fallen = (alone(spec, name).setup("green").object for name in ("shot", "falloff"))
    middle = even.shape[0] // 2
    edge = middle + round(16 * scene(spec).geometry.px_per_deg)
    assert fallen[middle, edge] / even[middle, edge] == pytest.approx(np.cos(np.radians(16)) ** 4, abs=0.005)
    assert fallen[middle, middle] == pytest.approx(even[middle, middle], rel=1e-4)


def prepared_frame(of: World, flat: bool) -> np.ndarray:
    """A frame as the solver gets it, with the head's flat frame and bad pixels or without them."""
    calibration = simulated_calibration(of if flat else alone(PLAIN))
    grid = Grid.periodic(of.shape, 1, float("inf"))
    counts = expected(of) / of.spec.camera.gain_e_per_dn + of.spec.camera.black_dn
    return Preparer(calibration, grid)(counts.astype(np.float32)).y.copy()


def test_unequal_pixels_are_gone_with_the_flat_frame() -> None:
    spec = having(PLAIN, sensor={"prnu": 0.02})
    true, uncorrected, corrected = (
        prepared_frame(alone(spec), False), prepared_frame(alone(spec, "prnu"), False),
        prepared_frame(alone(spec, "prnu"), True),
    )  # fmt: skip
    bright = true > 0.3 * true.max()
    assert (uncorrected[bright] / true[bright]).std() == pytest.approx(0.02, rel=0.05)
    assert (corrected[bright] / true[bright]).std() < 1e-3


def test_pixels_with_a_zero_of_their_own_are_gone_with_the_dark_frame() -> None:
    spec = having(PLAIN, sensor={"dsnu_e": 400.0})
    of, ideal = alone(spec, "dsnu"), alone(spec)
    lit, dark, true = (exposed(of), exposed(of, lit=False), exposed(ideal))
    assert (lit.astype(int) - true).std() * spec.camera.gain_e_per_dn == pytest.approx(400, rel=0.05)
    kept = dark > 0  # below zero the converter ends
    assert (lit.astype(int) - dark - true + spec.camera.black_dn)[kept].std() < 1


def test_hot_pixels_are_full_and_known() -> None:
    spec = having(PLAIN, sensor={"hot_pixels": 1e-3})
    of = alone(spec, *CORE, "hot", "saturation")
    hot = hot_pixels(of.scene)
    assert 60 < hot.sum() < 200  # of 129600
    assert (exposed(of, lit=False)[hot] > 0.98 * spec.camera.white_dn).all()
    assert (exposed(of)[~hot] < spec.camera.white_dn).all()
    known = simulated_calibration(of).bad
    assert known is not None
    assert np.array_equal(known, hot)


def test_a_mosaic_keeps_light_away_and_its_flat_frame_does_not_make_up_for_it() -> None:
    spec = having(PLAIN, sensor={"bayer": True})
    ratio = expected(alone(spec, "bayer")) / np.maximum(expected(alone(spec)), 1)
    there = expected(alone(spec)) > 5000
    for row, col, share in ((0, 0, 0.1), (0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.1)):  # RGGB in green light
        assert ratio[row::2, col::2][there[row::2, col::2]] == pytest.approx(share, abs=0.01)
    flat = simulated_calibration(alone(spec, "bayer")).flat
    assert flat == pytest.approx(np.ones(flat.shape), abs=1e-5)


def test_a_full_well_is_the_end() -> None:
    spec = having(PLAIN, peak_e=3 * PLAIN.camera.full_well_e)
    assert effect_named("saturation").size(scene(spec)).eta > 1
    assert exposed(alone(spec, "saturation")).max() == spec.camera.white_dn
    assert exposed(alone(spec)).max() > 2 * spec.camera.white_dn


@pytest.mark.parametrize("bend", [0.05, -0.05])
def test_a_bend_is_quadratic(bend: float) -> None:
    spec = having(PLAIN, sensor={"nonlinearity": bend})
    straight, bent = expected(alone(spec)), expected(alone(spec, "nonlinearity"))
    assert bent == pytest.approx(straight * (1 + bend * straight / spec.camera.full_well_e), abs=2)


@pytest.mark.parametrize(("name", "variance"), [("shot", 1.0), ("read", 0.0), ("quantisation", 0.0)])
def test_noise_is_poissons_and_the_readers(name: str, variance: float) -> None:
    frame = exposed(alone(PLAIN, name)).astype(float)
    gain = PLAIN.camera.gain_e_per_dn
    true = expected(alone(PLAIN))
    there = true > 3000
    error = (frame - PLAIN.camera.black_dn) * gain - true
    read = PLAIN.camera.read_noise_e**2 if name == "read" else 0.0
    assert error[there].var() == pytest.approx(variance * true[there].mean() + read + gain**2 / 12, rel=0.05)


def test_a_calibration_through_a_dot_is_blurred_by_it() -> None:
    sharp, dotted = (simulated_calibration(alone(having(PLAIN, calibration={"source_um": um}), "source")).psfs[0].pixels
                     for um in (0.0, 800.0))  # fmt: skip
    dot_px = 800.0 * 0.75 * 6000 / 25000 / PLAIN.camera.pitch_um
    wider = np.subtract(spread(np.maximum(dotted, 0)), spread(np.maximum(sharp, 0)))
    assert wider == pytest.approx((dot_px**2 / 16, dot_px**2 / 16), rel=0.25)  # the variance of a disc along one axis


def test_bandwidth_is_three_lines() -> None:
    assert alone(PLAIN, "bandwidth").setup("green").lines == 3


@pytest.mark.parametrize("light", [
    {"led_spread": 0.5}, {"led_spread": 0.5, "dead_led": 3}, {"ring_offset_um": 1000.0, "dead_led": 3},
])  # fmt: skip
def test_leds_are_a_common_gain_while_the_pupil_cuts_no_ray(light: dict[str, float]) -> None:
    spec = having(PLAIN, light=light)
    assert effect_named("leds").size(scene(spec)).eta == 0
    assert np.array_equal(expected(alone(spec, "leds")), expected(alone(spec, "shot")))


def test_a_screen_is_not_lit_by_the_leds() -> None:
    spec = having(PLAIN, eye={"shown_by": "screen"}, light={"ring_offset_um": 5000.0})
    assert effect_named("leds").size(scene(spec)).eta == 0
    assert np.array_equal(expected(alone(spec, "leds")), expected(alone(spec, "shot")))


F1_MM, F2_MM = 37.5, 50.0  # the paper's relay


def ray_at_the_pupil(led_mm: float, slope: float, offset_mm: float) -> tuple[float, float]:
    """Height and slope at the eye's pupil of a ray that leaves an LED: free flights and thin lenses in turn."""
    height = led_mm + slope * (F2_MM + offset_mm)
    slope -= height / F2_MM
    height += slope * (F1_MM + F2_MM)
    slope -= height / F1_MM
    return height + slope * F1_MM, slope


@pytest.mark.parametrize("offset_mm", [-12.0, 2.0, 5.0])
@pytest.mark.parametrize("decentred_mm", [0.0, 0.3])
def test_the_light_on_the_retina_is_that_of_the_rays_that_enter_the_pupil(offset_mm, decentred_mm) -> None:
    spec = having(PLAIN, light={"ring_offset_um": 1000 * offset_mm, "dead_led": 5},
                  eye={"decentred_um": 1000 * decentred_mm})  # fmt: skip
    here, soft_mm = scene(spec), 0.75 * EMITTER_MM / 2
    leds = [(4.75 * np.cos(pi * k / 6), 4.75 * np.sin(pi * k / 6)) for k in range(12) if k != 5]
    compared = 0
    for at_deg in ((0.0, 0.0), (7.0, 3.0), (-9.0, 9.0), (2.0, -16.0), (-16.0, 0.0)):
        slopes = [-0.75 * np.radians(x) for x in at_deg]  # of the LED's ray, by the angular magnification
        entered, certain = 0, True
        for led in leds:
            right, down = (ray_at_the_pupil(x, psi, offset_mm) for x, psi in zip(led, slopes, strict=True))
            assert (right[1], down[1]) == pytest.approx(np.radians(at_deg), abs=1e-12)
            away_mm = np.hypot(right[0] + decentred_mm, down[0])  # the image is turned: the pupil's shift counts back
            entered += away_mm < 3.85
            certain &= abs(away_mm - 3.85) > soft_mm
        if certain:
            compared += 1
            lit = lit_share(here, *(np.array(x) for x in at_deg))
            assert lit == pytest.approx(entered / len(leds), abs=1e-9)
    assert compared


def test_a_dead_led_darkens_the_side_that_it_lights() -> None:
    spec = having(PLAIN, light={"ring_offset_um": 5000.0})
    edge = np.array([16.0, -16.0]), np.zeros(2)
    whole, broken = (lit_share(scene(having(spec, light={"dead_led": dead})), *edge) for dead in (None, 0))  # 0: right
    assert whole[0] == pytest.approx(whole[1], rel=1e-9)
    assert broken[0] < 0.95 * broken[1]


def test_a_ring_whose_light_never_enters_the_pupil_is_refused() -> None:
    spec = having(PLAIN, eye={"pupil_um": 4000.0}, light={"ring_offset_um": 500.0})
    with pytest.raises(SpecError, match="no LED's light enters the pupil"):
        effect_named("leds").size(scene(spec))


def test_a_dead_led_that_the_ring_does_not_have_is_refused() -> None:
    with pytest.raises(SpecError, match="the ring has the LEDs 0 to 11"):
        effect_named("leds").size(scene(having(PLAIN, light={"ring_offset_um": 3000.0, "dead_led": 12})))


def test_the_leds_stand_where_the_heads_matrix_has_its_ring() -> None:
    light = PLAIN.light.model_copy(update={"chain": ChainSpec()})
    spec = PLAIN.model_copy(update={"light": light})
    at = leds_mm(scene(spec))
    assert len(at) == 8
    assert np.hypot(*np.transpose(at)) == pytest.approx(np.full(8, 10.04 / 2), abs=0.1)


class Dust:
    """A dark spot that stays where it is: the example of device/sim/README.md, as a newcomer would write it."""

    name = "dust"

    def size(self, scene: Scene) -> Size:
        return Size(1.0, "a spot of 40 pixels")

    def apply(self, setup: Setup) -> None:
        spot = np.ones(setup.shape, np.float32)
        spot[100:140, 200:240] = 0.5
        setup.respond(spot)


def test_a_newcomers_effect_is_planned_simulated_and_listed() -> None:
    dusty = world(PLAIN, effects=(*EFFECTS, Dust()))
    darker = expected(dusty) / np.maximum(expected(world(PLAIN)), 1)
    assert darker[100:140, 200:240] == pytest.approx(0.5, abs=1e-3)
    assert darker[150:170, 200:240] == pytest.approx(1.0, abs=1e-3)
    assert re.search(r"^dust +simulated +1 +a spot of 40 pixels$", table(dusty.plan), re.MULTILINE)
    left_out = world(PLAIN, effects=(*EFFECTS, Dust()), without=["dust"])
    assert np.array_equal(expected(left_out), expected(world(PLAIN)))


@pytest.mark.parametrize("chosen", ["only", "without"])
def test_an_effect_that_does_not_exist_is_refused_with_a_guess(chosen: str) -> None:
    with pytest.raises(SettingError, match="no effect is called 'refractoin'") as error:
        decide(scene(PLAIN), **{chosen: ["refractoin"]})
    assert "'refraction'" in error.value.remedy
    with pytest.raises(SettingError) as error:
        decide(scene(PLAIN), **{chosen: ["xyzzy"]})
    assert all(effect.name in error.value.remedy for effect in EFFECTS)


def test_a_plan_follows_its_rule_and_its_orders() -> None:
    here = scene(having(PLAIN, eye={"m_dpt": 0.005}, light={"stray": 0.1}))
    planned = {one.name: one for one in decide(here)}
    assert 0 < planned["refraction"].eta < 0.05
    assert not planned["refraction"].simulated
    assert planned["stray"].simulated
    assert all(one.simulated for one in decide(here, everything=True))
    assert [one.name for one in decide(here, only=["stray", "leds"]) if one.simulated] == ["leds", "stray"]
    assert not {one.name: one for one in decide(here, everything=True, without=["stray"])}["stray"].simulated
    assert [one.name for one in decide(here)] == [effect.name for effect in EFFECTS]
    assert all(isinstance(one, Decision) for one in decide(here))


def test_the_readme_shows_the_plan_as_the_command_prints_it() -> None:
    readme = (SCENES.parents[2] / "README.md").read_text()
    assert table(decide(scene(load_head(SCENES / "calm.toml")))) in readme
    assert len(EFFECTS) == 23, "the README says how many there are"
