"""Effects one by one: no change at their defaults, growth with their keys, and correct physics at large values."""

import re
from math import asin, cos, degrees, pi, sin

import numpy as np
import pytest

from device.config.head_file import ChainSpec, InstrumentSpec, load_head
from device.errors import SettingError, SpecError
from device.optics.diffuser import Refraction
from device.optics.led_cap import relative_intensity
from device.optics.matrix import EMITTER_MM
from device.recon.model.grid import Grid
from device.recon.model.preprocessing import Preprocessor
from device.sim.effects import EFFECTS
from device.sim.effects.eye import curvature_dpt, reflex_blobs, reflex_deg
from device.sim.effects.illumination import leds_mm, lit_share, pulse_light, pulse_swing
from device.sim.effects.sensor import hot_pixels
from device.sim.fundus import Fundus
from device.sim.optical_setup import OpticalSetup, Scene, Size
from device.sim.plan import Decision, build_setup, decide, format_plan
from device.sim.render import electrons_per_s, psf
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from tests.simulated import SCENES, coarse, expected_electrons, exposed_counts, with_keys, world

PLAIN = with_keys(coarse(load_head(SCENES / "healthy.toml"), 4), peak_e=15000.0)
CORE = ("shot", "read", "quantisation")
MOVING = {"eye": {"drift_deg_per_s": 1.0}}
CORNEA = {"eye": {"shown_by": "human eye"}, "light": {"ring_um": 4500.0}}

KEYS = [  # effect, table, key, growing values, further keys of the scene
    ("falloff", "light", "falloff", (False, True), {}),
    ("reflex", "light", "polariser_leak", (0.0, 1e-4, 1e-3), CORNEA),
    ("leds", "light", "ring_offset_um", (0.0, 1500.0, 3000.0), {}),
    ("leds", "light", "ring_offset_um", (0.0, -1500.0, -3000.0), {"light": {"dead_led": 3}}),
    ("stray", "light", "stray", (0.0, 1e-3, 0.1), {}),
    ("ambient", "light", "ambient", (0.0, 1e-3, 0.1), {}),
    ("gradient", "light", "stray_gradient", (0.0, 1e-3, 0.6), {}),
    ("pwm", "light", "pwm_hz", (0.0, 20005.0, 405.0), {"sensor": {"line_s": 3e-5}}),
    ("pwm", "sensor", "line_s", (0.0, 3e-5), {"light": {"pwm_hz": 405.0}}),
    ("ghost", "light", "ghost", (0.0, 1e-3, 0.3), {}),
    ("dust", "sensor", "dust_spots", (0, 1, 14), {}),
    ("gain_step", "sensor", "gain_step", (0.0, 1e-3, 0.02), {}),
    ("gain_step", "sensor", "gain_step", (0.0, -1e-3, -0.02), {}),
    ("columns", "sensor", "column_noise_e", (0.0, 0.5, 4.0), {}),
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
    ("accommodation", "eye", "accommodation_slope", (0.0, 0.5, 0.9), {"eye": {"m_dpt": -2.0}}),
    ("accommodation", "eye", "accommodation_lead_dpt", (0.0, 0.3, 1.0), {}),
    ("accommodation", "eye", "fixation_dpt", (0.0, 0.5, 3.0), {"eye": {"accommodation_slope": 0.9}}),
    ("oblique", "eye", "oblique_dpt", (0.0, 0.5, 3.0), {}),
    ("tilt", "eye", "retina_tilt_deg", ((0.0, 0.0), (1.0, 0.0), (-3.0, 4.0)), {}),
    ("tilt", "eye", "retina_decentred_um", ((0.0, 0.0), (0.0, 200.0), (-500.0, 0.0)), {}),
    ("tear_film", "eye", "tear_film_per_s", (0.0, 1e-3, 1e-2), {"eye": {"since_blink_s": 15.0}}),
    ("tear_film", "eye", "since_blink_s", (0.0, 12.0, 20.0), {"eye": {"tear_film_per_s": 0.01}}),
]
ALWAYS = {"shot", "read", "quantisation", "bandwidth"}  # present in every sensor and every LED


def effect_named(name: str):
    return next(effect for effect in EFFECTS if effect.name == name)


def scene(spec: InstrumentSpec) -> Scene:
    return Scene(spec, spec.light.colour)


def alone(spec: InstrumentSpec, *names: str) -> World:
    return world(spec, only=names or ("leds",))  # LEDs change nothing here: not even noise


@pytest.mark.parametrize(("name", "where", "key", "values", "also"), KEYS)
def test_a_size_is_zero_at_the_default_and_grows_with_its_key(name, where, key, values, also) -> None:
    spec = with_keys(PLAIN, **also)
    assert getattr(getattr(PLAIN.sim, where), key) == values[0], "the first value is the default"
    sizes = [effect_named(name).size(scene(with_keys(spec, **{where: {key: value}}))).eta for value in values]
    assert sizes[0] == 0
    assert sizes == sorted(sizes)
    assert sizes[-1] > sizes[0]


@pytest.mark.parametrize("name", [effect.name for effect in EFFECTS if effect.name not in ALWAYS])
def test_an_effect_at_its_default_changes_no_pixel(name: str) -> None:
    assert effect_named(name).size(scene(PLAIN)).eta == 0
    without, with_it = (exposed_counts(alone(PLAIN, *CORE, *more)) for more in ((), (name,)))
    if name in ("curvature", "pupil"):  # the same caustic in 25 parts: rounding may change a random draw
        assert (without != with_it).mean() < 0.01
        assert (np.abs(without.astype(int) - with_it) > 1).mean() < 1e-4
    else:
        assert np.array_equal(without, with_it)


def test_tint_is_zero_in_green_and_grows_from_blue_to_red() -> None:
    sizes = [effect_named("tint").size(Scene(PLAIN, colour)).eta for colour in ("green", "blue", "red")]
    assert sizes[0] == 0
    assert sizes == sorted(sizes)
    dots = with_keys(PLAIN, object={"kind": "dots"})
    assert effect_named("tint").size(Scene(dots, "red")).eta == 0


def point_passes(angle_deg: float, turn: float) -> float:
    """Return the share of a point's light that passes the iris, with the beam walk of the paper's relay."""
    at_deg = (angle_deg * np.cos(turn), angle_deg * np.sin(turn))
    spec = with_keys(PLAIN, object={"kind": "point", "at_deg": at_deg}, eye={"walks": True})
    setup = OpticalSetup(scene(spec), world(PLAIN).retina, world(PLAIN).sensor)
    effect_named("pupil").apply(setup)
    return float(psf(setup, at_deg).sum(dtype=np.float64))


@pytest.mark.parametrize("turn", [0.0, 2.2])
@pytest.mark.parametrize(
    ("angle_deg", "share"), [(15, 1.0), (25, 1.0), (26, 0.969), (28, 0.624), (30, 0.180), (31, 0.014)]
)
def test_beam_walk_vignetting_is_that_of_the_ray_trace(angle_deg: float, share: float, turn: float) -> None:
    assert point_passes(angle_deg, turn) == pytest.approx(share, abs=0.002)  # scene S8; OPTICS.md 1.4


def dot(spec: InstrumentSpec, *names: str, at_px: tuple[int, int] = (0, 0)) -> tuple[OpticalSetup, np.ndarray]:
    """Return one bright pixel, right and down of the middle, through the named effects."""
    here = scene(spec)
    plane = np.zeros((133, 133), np.float32)
    plane[66 + at_px[1], 66 + at_px[0]] = 1
    chosen = [decision for decision in decide(here, only=names) if decision.simulated]
    setup = build_setup(here, Fundus(dict.fromkeys(("red", "green", "blue"), plane), plane > 0), chosen)
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


def test_motion_blur_widens_along_the_drift_and_conserves_light() -> None:
    spec = with_keys(PLAIN, eye={"drift_deg_per_s": 60.0})
    still, moved = dot(spec, "shot")[1], dot(spec, "motion")[1]
    way_px = 60.0 * spec.camera.exposure_s * scene(spec).geometry.px_per_deg
    wider = np.subtract(spread(moved), spread(still))
    assert wider == pytest.approx((way_px**2 / 12, 0), abs=1.5)  # the variance of an even smear: 45 px2
    assert centroid(moved) == pytest.approx(centroid(still), abs=0.02)


def test_motion_blur_does_not_wrap_around() -> None:
    spec = with_keys(PLAIN, eye={"drift_deg_per_s": 120.0})  # a saccade: 47 pixels
    _, image = dot(spec, "motion", at_px=(60, 0))
    assert image[:, :150].max() < 1e-3 * image.max()


def test_rolling_shutter_skews_the_image() -> None:
    spec = with_keys(PLAIN, eye={"drift_deg_per_s": 50.0}, sensor={"line_s": 1e-4})
    lag_px = 50.0 * 1e-4 * scene(spec).geometry.px_per_deg
    moved = []
    for down in (-60, 60):
        still, skewed = (dot(spec, name, at_px=(0, down))[1] for name in ("shot", "shutter"))
        moved.append(centroid(skewed)[0] - centroid(still)[0])
    assert moved == pytest.approx([-60 * lag_px, 60 * lag_px], abs=0.2)


def test_a_rolling_shutter_wraps_nothing_round_the_edge() -> None:
    spec = with_keys(PLAIN, eye={"drift_deg_per_s": 200.0}, sensor={"line_s": 1e-3})
    narrow = spec.model_copy(update={"camera": spec.camera.model_copy(update={"cols": 240})})
    wide_image, image = (expected_electrons(alone(head, "shutter")) for head in (spec, narrow))
    both = [frame / frame[135].max() for frame in (wide_image[:, 120:360], image)]
    assert both[0] == pytest.approx(both[1], abs=2e-3)


def test_myopia_scales_the_caustic() -> None:
    spec = with_keys(PLAIN, eye={"m_dpt": 8.0})
    relaxed, myope = (dot(spec, name)[1] for name in ("shot", "refraction"))
    scale = 1 - scene(spec).geometry.scale_per_dpt * 8.0
    assert np.sqrt(spread(myope)[0] / spread(relaxed)[0]) == pytest.approx(scale, abs=0.003)


def test_flat_surface_is_myopic_at_its_edge() -> None:
    """OPTICS.md 6.4: 12 and 7.5 mm on a flat screen behind a 25 mm lens."""
    here = scene(with_keys(PLAIN, eye={"surface": "flat"}))
    at_12_mm = curvature_dpt(here, degrees(np.arctan(12 / 25)))
    assert at_12_mm == pytest.approx((4.68, 9.82), abs=0.01)
    assert curvature_dpt(here, degrees(np.arctan(7.5 / 25))) == pytest.approx((2.0, 3.84), abs=0.01)
    setup = OpticalSetup(here, world(PLAIN).retina, world(PLAIN).sensor)
    effect_named("curvature").apply(setup)
    right, down = (setup.aberrations["curvature"](place) for place in ((16.0, 0.0), (0.0, 16.0)))
    assert right == pytest.approx(Refraction(down.m_dpt, -down.j0_dpt, 0.0), abs=1e-9)
    assert right.j0_dpt > 0, "the tangential meridian is the stronger one, and lies along the radius"


def test_oblique_astigmatism_is_radial_and_grows_with_the_square_of_the_angle() -> None:
    here = scene(with_keys(PLAIN, eye={"oblique_dpt": 3.0, "gaze_deg": (5.0, 0.0)}))
    setup = OpticalSetup(here, world(PLAIN).retina, world(PLAIN).sensor)
    effect_named("oblique").apply(setup)
    cylinder = setup.aberrations["oblique"]
    assert cylinder((5.0, 0.0)) == pytest.approx((0, 0, 0)), "the gaze moves the eye's axis"
    assert cylinder((35.0, 0.0)) == pytest.approx((0, 1.5, 0)), "half the difference of the meridians at 30 degrees"
    assert cylinder((5.0, 15.0)) == pytest.approx((0, -1.5 / 4, 0))
    assert cylinder((5.0 + 15 / np.sqrt(2), 15 / np.sqrt(2))) == pytest.approx((0, 0, 1.5 / 4))


def test_a_turn_to_a_fixation_target_moves_the_axis_of_the_eye() -> None:
    eyes = world(with_keys(PLAIN, eye={"oblique_dpt": 3.0}))
    straight = eyes.setup("green").aberrations["oblique"]((0.0, 0.0))
    eyes.present_eye("OD", "nerve")
    setup = eyes.setup("green")
    assert straight == pytest.approx((0, 0, 0))
    assert setup.aberrations["oblique"](setup.scene.axis_deg) == pytest.approx((0, 0, 0))
    off_deg = np.hypot(*setup.scene.axis_deg)
    turned = setup.aberrations["oblique"]((0.0, 0.0))
    assert np.hypot(turned.j0_dpt, turned.j45_dpt) == pytest.approx(1.5 * (off_deg / 30) ** 2)
    assert off_deg > 5


@pytest.mark.parametrize(
    ("keys", "edge_dpt"),
    [
        ({"retina_decentred_um": (500.0, 0.0)}, (0.560, 0.0)),  # OPTICS.md 3.10
        ({"retina_tilt_deg": (0.0, 5.0)}, (0.0, 1.176)),  # tan 5 deg tan 16.7 deg / (1.336 * 16.7 mm)
    ],
)
def test_a_tilted_retina_is_myopic_on_its_deeper_side(keys: dict[str, object], edge_dpt: tuple[float, float]) -> None:
    eye = {"shown_by": "human eye", "focal_length_um": 16700.0} | keys
    setup = OpticalSetup(scene(with_keys(PLAIN, eye=eye)), world(PLAIN).retina, world(PLAIN).sensor)
    effect_named("tilt").apply(setup)
    sphere = setup.aberrations["tilt"]
    assert (sphere((16.7, 0.0)).m_dpt, sphere((0.0, 16.7)).m_dpt) == pytest.approx(edge_dpt, abs=1e-3)
    assert sphere((-16.7, -16.7)).m_dpt == pytest.approx(-sphere((16.7, 16.7)).m_dpt)
    assert sphere((16.7, 0.0))[1:] == (0.0, 0.0), "a tilt is no cylinder"


@pytest.mark.parametrize(
    ("m_dpt", "target_dpt", "slope", "lead_dpt", "seen_dpt"),
    [
        (0.0, 3.0, 0.88, 0.0, 2.64),  # lag of 0.36 dpt
        (0.0, 0.0, 0.88, 0.3, 0.3),  # lead of a far target
        (-2.0, 0.0, 1.0, 0.0, 0.0),  # latent: the eye accommodates its whole refractive error
        (-2.0, 0.0, 0.0, 0.0, -2.0),  # cycloplegia
        (3.0, 1.0, 0.88, 0.3, 3.0),  # the target lies beyond the far point
        (0.0, 8.0, 0.88, 0.0, 5.0),  # no more than the amplitude
    ],
)
def test_accommodation_adds_its_response_to_the_mean_sphere(m_dpt, target_dpt, slope, lead_dpt, seen_dpt) -> None:
    eye = {
        "m_dpt": m_dpt,
        "j0_dpt": 0.5,
        "fixation_dpt": target_dpt,
        "accommodation_slope": slope,
        "accommodation_lead_dpt": lead_dpt,
        "accommodation_amplitude_dpt": 5.0,
    }
    found = alone(with_keys(PLAIN, eye=eye), "refraction", "accommodation").setup("green").refraction
    assert found == pytest.approx((seen_dpt, 0.5, 0.0))


def test_another_colour_of_light_meets_another_focus_of_a_human_eye_only() -> None:
    person = with_keys(PLAIN, eye={"shown_by": "human eye", "m_dpt": -1.0, "j45_dpt": 0.5})
    chromatic = effect_named("chromatic")
    found = {}
    for colour in ("red", "green", "amber", "blue"):
        setup = OpticalSetup(Scene(person, colour), world(PLAIN).retina, world(PLAIN).sensor)
        effect_named("refraction").apply(setup)
        chromatic.apply(setup)
        found[colour] = setup.refraction.m_dpt
        assert setup.refraction[1:] == (0.0, 0.5)
    assert found["green"] == -1.0
    assert found["red"] == pytest.approx(-1.504, abs=0.001), "Thibos et al. 1992: less myopic in red"
    assert found["red"] < found["amber"] < found["green"] < found["blue"]
    assert chromatic.size(Scene(person, "green")).eta == 0
    assert chromatic.size(Scene(person, "red")).eta > 0.05
    assert chromatic.size(Scene(PLAIN, "red")).eta == 0, "a model eye is described at its own wavelength"


def test_a_broken_tear_film_lowers_contrast_and_conserves_light() -> None:
    spec = with_keys(PLAIN, eye={"tear_film_per_s": 0.02, "since_blink_s": 20.0, "tear_film_deg": 0.5})
    clear, broken = (alone(spec, name).setup("green") for name in ("shot", "tear_film"))
    assert broken.object.sum(dtype=np.float64) == pytest.approx(clear.object.sum(dtype=np.float64), rel=1e-5)
    still, blurred = (dot(spec, name)[1] for name in ("shot", "tear_film"))
    sigma_px = 0.5 * scene(spec).geometry.px_per_deg
    wider = np.subtract(spread(blurred), spread(still))
    assert wider == pytest.approx((0.2 * sigma_px**2,) * 2, rel=0.02), "a fifth of the light, after 10 s of break-up"
    assert effect_named("tear_film").size(scene(with_keys(spec, eye={"since_blink_s": 9.0}))).eta == 0, "not yet broken"


@pytest.mark.parametrize(("ring_um", "angle_deg"), [(4533.3, 8.5), (5973.3, 16.7)])
def test_corneal_reflex_is_at_the_predicted_angle(ring_um: float, angle_deg: float) -> None:
    """OPTICS.md 3.6: a ring of 1.7 mm at the pupil stands at 8.5 degrees, one of 2.24 mm at the field's edge."""
    here = scene(with_keys(PLAIN, eye={"shown_by": "human eye"}, light={"ring_um": ring_um, "polariser_leak": 1e-3}))
    ring_mm = ring_um / 2000 * 0.75
    assert reflex_deg(here) == pytest.approx(2 * degrees(asin(ring_mm / 7.8)) - 16.7, abs=1e-9)
    assert reflex_deg(here) == pytest.approx(angle_deg, abs=0.05)
    image = reflex_blobs(here, (700, 700))
    away_px, sigma_px = reflex_deg(here) * here.geometry.px_per_deg, 800 / PLAIN.camera.pitch_um
    assert spread(image) == pytest.approx((away_px**2 / 2 + sigma_px**2,) * 2, rel=0.01)  # blobs on a ring
    assert image.sum() == pytest.approx(12 * 2 * pi * sigma_px**2, rel=0.01)


def test_reflex_adds_light_only_inside_the_field() -> None:
    outside = with_keys(PLAIN, eye={"shown_by": "human eye"}, light={"ring_um": 9500.0, "polariser_leak": 1e-2})
    assert effect_named("reflex").size(scene(outside)).eta == 0
    assert np.array_equal(expected_electrons(alone(outside, "reflex")), expected_electrons(alone(outside)))
    inside = with_keys(outside, light={"ring_um": 4500.0})
    assert (expected_electrons(alone(inside, "reflex")) - expected_electrons(alone(inside))).mean() > 0


def test_stray_light_needs_the_lamp_and_ambient_light_does_not() -> None:
    spec = with_keys(PLAIN, light={"stray": 0.1, "ambient": 0.2})
    black, gain = spec.camera.black_dn, spec.camera.gain_e_per_dn
    lit = expected_electrons(alone(spec))
    mean_e = lit[lit > 0.05 * lit.max()].mean()
    dark = {name: (exposed_counts(alone(spec, name), lit=False) - black).mean() * gain for name in ("stray", "ambient")}
    assert dark == pytest.approx({"stray": 0.0, "ambient": 0.2 * mean_e}, rel=0.01)
    for name, share in (("stray", 0.1), ("ambient", 0.2)):
        more = expected_electrons(alone(spec, name)) - lit
        assert more == pytest.approx(np.full_like(more, share * mean_e), rel=0.01, abs=2)


def test_dark_current_appears_in_a_dark_frame() -> None:
    spec = with_keys(PLAIN, sensor={"dark_e_per_s": 30000.0})
    dark = (exposed_counts(alone(spec, "dark"), lit=False) - spec.camera.black_dn).mean() * spec.camera.gain_e_per_dn
    assert dark == pytest.approx(3000.0, rel=0.01)


def test_light_falls_off_with_the_fourth_power_of_the_cosine() -> None:
    spec = with_keys(PLAIN, light={"falloff": True})
    even, fallen = (alone(spec, name).setup("green").object for name in ("shot", "falloff"))
    middle = even.shape[0] // 2
    edge = middle + round(16 * scene(spec).geometry.px_per_deg)
    assert fallen[middle, edge] / even[middle, edge] == pytest.approx(np.cos(np.radians(16)) ** 4, abs=0.005)
    assert fallen[middle, middle] == pytest.approx(even[middle, middle], rel=1e-4)


def test_wide_dies_light_beyond_the_field_and_less_at_its_edge() -> None:
    """The high-power ring's 1 mm dies, as OPTICS.md 4.9 has them; without the effect the field ends sharply."""
    spec = coarse(load_head(SCENES / "human_eye_imx296_power.toml"), 8)
    sharp, soft = (alone(spec, name).setup("green").object for name in ("shot", "penumbra"))
    here = scene(spec)
    assert effect_named("penumbra").size(here).eta > 1

    def seen(plane: np.ndarray, right_px: int, down_px: int) -> float:
        middle = plane.shape[0] // 2
        return float(plane[middle + down_px, middle + right_px])

    for angle_deg, turn in ((10, 0.0), (14, 0.7), (16, pi / 2)):
        at = [round(angle_deg * way * here.geometry.px_per_deg) for way in (cos(turn), sin(turn))]
        left = seen(soft, *at) / seen(sharp, *at) / (seen(soft, 0, 0) / seen(sharp, 0, 0))
        off_deg = np.array(at) / here.geometry.px_per_deg
        assert left == pytest.approx(relative_intensity(here.cap, 0.75, *off_deg), abs=0.03)  # a pixel is 0.35 degrees
    assert sharp.shape[0] < 40 * here.geometry.px_per_deg < soft.shape[0]
    assert seen(soft, round(20 * here.geometry.px_per_deg), 0) > 0
    assert effect_named("penumbra").size(scene(PLAIN)).eta == 0, "nothing is known of its dies"


def prepared_frame(of: World, flat: bool) -> np.ndarray:
    """Return a frame after preprocessing, with the head's flat frame and bad pixels or without them."""
    calibration = simulated_calibration(of if flat else alone(PLAIN))
    grid = Grid.periodic(of.shape, 1, float("inf"))
    counts = expected_electrons(of) / of.spec.camera.gain_e_per_dn + of.spec.camera.black_dn
    return Preprocessor(calibration, grid)(counts.astype(np.float32)).y.copy()


def test_flat_frame_corrects_prnu() -> None:
    spec = with_keys(PLAIN, sensor={"prnu": 0.02})
    true, uncorrected, corrected = (
        prepared_frame(alone(spec), False),
        prepared_frame(alone(spec, "prnu"), False),
        prepared_frame(alone(spec, "prnu"), True),
    )
    bright = true > 0.3 * true.max()
    assert (uncorrected[bright] / true[bright]).std() == pytest.approx(0.02, rel=0.05)
    assert (corrected[bright] / true[bright]).std() < 1e-3


def test_dark_frame_corrects_dsnu() -> None:
    spec = with_keys(PLAIN, sensor={"dsnu_e": 400.0})
    of, ideal = alone(spec, "dsnu"), alone(spec)
    lit, dark, true = (exposed_counts(of), exposed_counts(of, lit=False), exposed_counts(ideal))
    assert (lit.astype(int) - true).std() * spec.camera.gain_e_per_dn == pytest.approx(400, rel=0.05)
    kept = dark > 0  # the converter clips at zero
    assert (lit.astype(int) - dark - true + spec.camera.black_dn)[kept].std() < 1


def test_hot_pixels_saturate_and_are_in_the_calibration() -> None:
    spec = with_keys(PLAIN, sensor={"hot_pixels": 1e-3})
    of = alone(spec, *CORE, "hot", "saturation")
    hot = hot_pixels(of.scene)
    assert 60 < hot.sum() < 200  # of 129600
    assert (exposed_counts(of, lit=False)[hot] > 0.98 * spec.camera.white_dn).all()
    assert (exposed_counts(of)[~hot] < spec.camera.white_dn).all()
    known = simulated_calibration(of).bad
    assert known is not None
    assert np.array_equal(known, hot)


def test_bayer_mosaic_attenuates_and_the_flat_frame_does_not_amplify() -> None:
    spec = with_keys(PLAIN, sensor={"bayer": True})
    ratio = expected_electrons(alone(spec, "bayer")) / np.maximum(expected_electrons(alone(spec)), 1)
    bright = expected_electrons(alone(spec)) > 5000
    for row, col, share in ((0, 0, 0.1), (0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.1)):  # RGGB in green light
        assert ratio[row::2, col::2][bright[row::2, col::2]] == pytest.approx(share, abs=0.01)
    flat = simulated_calibration(alone(spec, "bayer")).flat
    assert flat == pytest.approx(np.ones(flat.shape), abs=1e-5)


def test_saturation_clips_at_the_full_well() -> None:
    spec = with_keys(PLAIN, peak_e=3 * PLAIN.camera.full_well_e)
    assert effect_named("saturation").size(scene(spec)).eta > 1
    assert exposed_counts(alone(spec, "saturation")).max() == spec.camera.white_dn
    assert exposed_counts(alone(spec)).max() > 2 * spec.camera.white_dn


@pytest.mark.parametrize("bend", [0.05, -0.05])
def test_nonlinearity_is_quadratic(bend: float) -> None:
    spec = with_keys(PLAIN, sensor={"nonlinearity": bend})
    straight, bent = expected_electrons(alone(spec)), expected_electrons(alone(spec, "nonlinearity"))
    assert bent == pytest.approx(straight * (1 + bend * straight / spec.camera.full_well_e), abs=2)


@pytest.mark.parametrize(("name", "variance"), [("shot", 1.0), ("read", 0.0), ("quantisation", 0.0)])
def test_noise_variance_is_shot_plus_read_plus_quantisation(name: str, variance: float) -> None:
    frame = exposed_counts(alone(PLAIN, name)).astype(float)
    gain = PLAIN.camera.gain_e_per_dn
    true = expected_electrons(alone(PLAIN))
    bright = true > 3000
    error = (frame - PLAIN.camera.black_dn) * gain - true
    read = PLAIN.camera.read_noise_e**2 if name == "read" else 0.0
    assert error[bright].var() == pytest.approx(variance * true[bright].mean() + read + gain**2 / 12, rel=0.05)


def test_calibration_psf_is_blurred_by_the_source_size() -> None:
    sharp, dotted = (
        simulated_calibration(alone(with_keys(PLAIN, calibration={"source_um": um}), "source")).psfs[0].pixels
        for um in (0.0, 800.0)
    )
    dot_px = 800.0 * 0.75 * 6000 / 25000 / PLAIN.camera.pitch_um
    wider = np.subtract(spread(np.maximum(dotted, 0)), spread(np.maximum(sharp, 0)))
    assert wider == pytest.approx((dot_px**2 / 16, dot_px**2 / 16), rel=0.25)  # the variance of a disc along one axis


def test_bandwidth_traces_three_wavelengths() -> None:
    assert alone(PLAIN, "bandwidth").setup("green").lines == 3


@pytest.mark.parametrize(
    "light",
    [
        {"led_spread": 0.5},
        {"led_spread": 0.5, "dead_led": 3},
        {"ring_offset_um": 1000.0, "dead_led": 3},
    ],
)
def test_leds_change_only_the_gain_while_the_pupil_cuts_no_ray(light: dict[str, float]) -> None:
    spec = with_keys(PLAIN, light=light)
    assert effect_named("leds").size(scene(spec)).eta == 0
    assert np.array_equal(expected_electrons(alone(spec, "leds")), expected_electrons(alone(spec, "shot")))


def test_a_screen_is_not_lit_by_the_leds() -> None:
    spec = with_keys(PLAIN, eye={"shown_by": "screen"}, light={"ring_offset_um": 5000.0})
    assert effect_named("leds").size(scene(spec)).eta == 0
    assert np.array_equal(expected_electrons(alone(spec, "leds")), expected_electrons(alone(spec, "shot")))


F1_MM, F2_MM = 37.5, 50.0  # the paper's relay


def ray_at_the_pupil(led_mm: float, slope: float, offset_mm: float) -> tuple[float, float]:
    """Return height and slope at the eye's pupil of a ray from an LED: free flights and thin lenses in turn."""
    height = led_mm + slope * (F2_MM + offset_mm)
    slope -= height / F2_MM
    height += slope * (F1_MM + F2_MM)
    slope -= height / F1_MM
    return height + slope * F1_MM, slope


@pytest.mark.parametrize("offset_mm", [-12.0, 2.0, 5.0])
@pytest.mark.parametrize("decentred_mm", [0.0, 0.3])
def test_lit_share_equals_ray_tracing_through_the_pupil(offset_mm, decentred_mm) -> None:
    spec = with_keys(
        PLAIN, light={"ring_offset_um": 1000 * offset_mm, "dead_led": 5}, eye={"decentred_um": 1000 * decentred_mm}
    )
    here, soft_mm = scene(spec), 0.75 * EMITTER_MM / 2
    leds = [(4.75 * np.cos(pi * k / 6), 4.75 * np.sin(pi * k / 6)) for k in range(12) if k != 5]
    compared = 0
    for at_deg in ((0.0, 0.0), (7.0, 3.0), (-9.0, 9.0), (2.0, -16.0), (-16.0, 0.0)):
        slopes = [-0.75 * np.radians(x) for x in at_deg]  # of the LED's ray, by the angular magnification
        entered, certain = 0, True
        for led in leds:
            right, down = (ray_at_the_pupil(x, psi, offset_mm) for x, psi in zip(led, slopes, strict=True))
            assert (right[1], down[1]) == pytest.approx(np.radians(at_deg), abs=1e-12)
            away_mm = np.hypot(right[0] + decentred_mm, down[0])  # the image is inverted, so the shift is added
            entered += away_mm < 3.85
            certain &= abs(away_mm - 3.85) > soft_mm
        if certain:
            compared += 1
            lit = lit_share(here, *(np.array(x) for x in at_deg))
            assert lit == pytest.approx(entered / len(leds), abs=1e-9)
    assert compared


def test_a_dead_led_darkens_the_side_that_it_lights() -> None:
    spec = with_keys(PLAIN, light={"ring_offset_um": 5000.0})
    edge = np.array([16.0, -16.0]), np.zeros(2)
    whole, broken = (
        lit_share(scene(with_keys(spec, light={"dead_led": dead})), *edge) for dead in (None, 0)
    )  # 0: right
    assert whole[0] == pytest.approx(whole[1], rel=1e-9)
    assert broken[0] < 0.95 * broken[1]


def test_a_ring_whose_light_never_enters_the_pupil_is_refused() -> None:
    spec = with_keys(PLAIN, eye={"pupil_um": 4000.0}, light={"ring_offset_um": 500.0})
    with pytest.raises(SpecError, match="no LED's light enters the pupil"):
        effect_named("leds").size(scene(spec))


def test_a_dead_led_that_the_ring_does_not_have_is_refused() -> None:
    with pytest.raises(SpecError, match="the ring has the LEDs 0 to 11"):
        effect_named("leds").size(scene(with_keys(PLAIN, light={"ring_offset_um": 3000.0, "dead_led": 12})))


def test_led_positions_are_those_of_the_heads_matrix() -> None:
    light = PLAIN.light.model_copy(update={"chain": ChainSpec()})
    spec = PLAIN.model_copy(update={"light": light})
    at = leds_mm(scene(spec))
    assert len(at) == 8
    assert np.hypot(*np.transpose(at)) == pytest.approx(np.full(8, 10.04 / 2), abs=0.1)


def shares(**keys: dict[str, object]) -> np.ndarray:
    """Return the noise-free light of a frame with changed keys over that without, where there is enough of it."""
    changed, plain = (expected_electrons(world(with_keys(PLAIN, **more))) for more in (keys, {}))
    return changed / np.where(plain > 0.02 * plain.max(), plain, np.nan)


def test_pulsed_leds_give_bands_of_rows_whose_range_has_a_closed_form() -> None:
    exposure_s = PLAIN.camera.exposure_s
    seen = shares(light={"pwm_hz": 105.0, "pwm_duty": 0.3}, sensor={"line_s": 1e-4})
    rows = np.nanmean(seen, axis=1)
    rows = rows[np.isfinite(rows)]
    assert np.nanstd(seen - np.nanmean(seen, axis=1, keepdims=True)) < 2e-3
    assert (rows.max() - rows.min()) / 2 == pytest.approx(pulse_swing(105.0, 0.3, exposure_s), rel=0.02)
    assert pulse_swing(105.0, 0.3, exposure_s) == pytest.approx(0.5 / 10.5)  # half a period of ten and a half
    assert pulse_swing(100.0, 0.3, exposure_s) == pytest.approx(0, abs=1e-12)  # whole periods
    every = pulse_light(np.linspace(0, 1 / 105, 1000, endpoint=False), exposure_s, 105.0, 0.3)
    assert every.mean() == pytest.approx(1, abs=1e-4)


def test_dust_and_a_gain_step_are_not_in_the_flat_frame_and_a_pattern_is() -> None:
    spec = with_keys(PLAIN, sensor={"dust_spots": 14, "gain_step": 0.02})
    assert simulated_calibration(world(spec)).flat is None
    both = with_keys(spec, sensor={"prnu": 0.01})
    flats = [simulated_calibration(world(with_keys(of, sensor={"prnu": 0.01}))).flat for of in (PLAIN, both)]
    assert np.array_equal(*flats)
    seen = shares(sensor={"dust_spots": 14, "dust_shade": 0.35})
    assert np.nanmin(seen) == pytest.approx(0.65, abs=0.01)
    assert np.nanmedian(seen) == pytest.approx(1, abs=0.01)
    left, right = np.array_split(shares(sensor={"gain_step": 0.02}), 2, axis=1)
    assert (np.nanmean(left), np.nanmean(right)) == pytest.approx((1, 1.02), abs=1e-3)


def test_a_ghost_is_the_image_once_more() -> None:
    at = (3.0, -2.0)
    spec = with_keys(PLAIN, light={"ghost": 0.25, "ghost_deg": at})
    single, double = (dot(spec, name)[1] for name in ("shot", "ghost"))
    away = np.rint(np.multiply(at, scene(spec).geometry.px_per_deg)).astype(int)
    both = single + 0.25 * np.roll(single, (away[1], away[0]), axis=(0, 1))
    assert double / double.max() == pytest.approx(both / both.max(), abs=1e-4)


def test_stray_light_with_a_gradient_is_a_plane() -> None:
    spec = with_keys(PLAIN, light={"stray_gradient": 0.6})
    more = expected_electrons(world(spec)) - expected_electrons(world(PLAIN))
    mean_e = world(spec)  # the mean of the lit pixels
    expected_electrons(mean_e)
    lit_e = mean_e.setup("green").added_light.lit_e_per_s * spec.camera.exposure_s
    cols = np.median(more, axis=0)
    assert cols == pytest.approx(0.6 * lit_e * np.linspace(0, 1, cols.size), abs=0.01 * lit_e)


def test_column_noise_is_one_offset_for_each_column() -> None:
    offset_e = world(with_keys(PLAIN, sensor={"column_noise_e": 20.0})).sensor.offset_e
    assert offset_e is not None
    assert np.ptp(offset_e, axis=0).max() == 0
    assert offset_e[0].std() == pytest.approx(20, rel=0.15)


class Bubbles:
    """Dark spot at a fixed place: the example of device/sim/README.md."""

    name = "bubbles"

    def size(self, scene: Scene) -> Size:
        return Size(1.0, "a spot of 40 pixels")

    def apply(self, setup: OpticalSetup) -> None:
        spot = np.ones(setup.shape, np.float32)
        spot[100:140, 200:240] = 0.5
        setup.multiply_response(spot)


def test_an_additional_effect_is_planned_simulated_and_listed() -> None:
    bubbly = world(PLAIN, effects=(*EFFECTS, Bubbles()))
    darker = expected_electrons(bubbly) / np.maximum(expected_electrons(world(PLAIN)), 1)
    assert darker[100:140, 200:240] == pytest.approx(0.5, abs=1e-3)
    assert darker[150:170, 200:240] == pytest.approx(1.0, abs=1e-3)
    assert re.search(r"^bubbles +simulated +1 +a spot of 40 pixels$", format_plan(bubbly.plan), re.MULTILINE)
    left_out = world(PLAIN, effects=(*EFFECTS, Bubbles()), without=["bubbles"])
    assert np.array_equal(expected_electrons(left_out), expected_electrons(world(PLAIN)))


@pytest.mark.parametrize("chosen", ["only", "without"])
def test_an_unknown_effect_is_refused_with_the_closest_name(chosen: str) -> None:
    with pytest.raises(SettingError, match="no effect is called 'refractoin'") as error:
        decide(scene(PLAIN), **{chosen: ["refractoin"]})
    assert "'refraction'" in error.value.remedy
    with pytest.raises(SettingError) as error:
        decide(scene(PLAIN), **{chosen: ["xyzzy"]})
    assert all(effect.name in error.value.remedy for effect in EFFECTS)


def test_plan_follows_threshold_and_options() -> None:
    here = scene(with_keys(PLAIN, eye={"m_dpt": 0.005}, light={"stray": 0.1}))
    planned = {decision.name: decision for decision in decide(here)}
    assert 0 < planned["refraction"].eta < 0.05
    assert not planned["refraction"].simulated
    assert planned["stray"].simulated
    assert all(decision.simulated for decision in decide(here, everything=True))
    only = decide(here, only=["stray", "leds"])
    assert [decision.name for decision in only if decision.simulated] == ["leds", "stray"]
    others = decide(here, everything=True, without=["stray"])
    assert [decision.simulated for decision in others if decision.name == "stray"] == [False]
    with pytest.raises(SettingError, match="cannot both be selected"):
        decide(here, everything=True, only=["stray"])
    assert [decision.name for decision in decide(here)] == [effect.name for effect in EFFECTS]
    assert all(isinstance(decision, Decision) for decision in decide(here))


def test_the_documents_show_the_plan_as_the_command_prints_it() -> None:
    root = SCENES.parents[2]
    page = (root / "services/research/site/simulation.md").read_text()
    assert format_plan(decide(scene(load_head(SCENES / "calm.toml")))) in page
    comparison = (root / "services/research/site/comparison.md").read_text()
    for document in (page, comparison, (root / "README.md").read_text()):
        assert f" {len(EFFECTS)} effects" in document
