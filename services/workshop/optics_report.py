"""Optical budget as text: the table of one head, or a comparison of all sensors. Formulas are in `device/optics`."""

from dataclasses import replace
from pathlib import Path

from device.calibration.procedure.point_source import BORDER
from device.config.head_file import InstrumentSpec, load_head
from device.config.sensors import known_sensors
from device.errors import SettingError
from device.optics.budget import Design, OpticalBudget, Side, design_of_head, design_of_sensor, optical_budget
from device.optics.eye import Relay, size_mm
from device.optics.field_extent import extent_mm, half_shift_mm, half_shift_tan_mm, strict_field_deg
from device.optics.light_path import LightPath, load_light_path, relay_of
from services import resources

FIELDS_DEG = (33.4, 45.0, 48.3, 50.0, 51.2)
MODEL_EYE_MM = 25.0  # focal length of the model eye in front of the paper's rulers and screens
ENOUGH = 0.5  # minimum share of the light of the field edge, with a solver for the cropped frame (OPTICS.md 1.5)


def design(head: Path | None, sensor: str | None, eye_mm: float | None, pupil_mm: float | None) -> Design:
    """Return the design of a head file or else of a sensor; the light path is that of `hardware/optics.toml`.

    `eye_mm` (focal length) and `pupil_mm` (diameter) replace those of the design. SettingError for an unknown sensor.
    """
    path = load_light_path(resources.LIGHT_PATH)
    if head is not None:
        found = design_of_head(path, load_head(head))
    elif sensor is not None and sensor in known_sensors():
        found = design_of_sensor(path, known_sensors()[sensor])
    else:
        raise SettingError(f"no sensor is called {sensor!r}", f"Choose one of {', '.join(sorted(known_sensors()))}.")
    return replace(found, eye_mm=eye_mm or found.eye_mm, pupil_mm=pupil_mm or found.pupil_mm)


def design_of(spec: InstrumentSpec) -> Design:
    """Return the design of a head's specification, with the light path of `hardware/optics.toml`."""
    return design_of_head(load_light_path(resources.LIGHT_PATH), spec)


def widest_iris_mm(chosen: Design) -> float:
    """Return the diameter of the widest iris whose caustic the calibration takes on this sensor: its border is dark."""
    return (1 - 2 * BORDER) * chosen.sides_mm[1]


def table(chosen: Design) -> str:
    """Return the whole budget of one design, one line per quantity."""
    budget = optical_budget(chosen)
    rows = [*_field(chosen, budget), *_scale(chosen, budget), *_eye(chosen, budget), *_light(chosen, budget)]
    head = f"{chosen.title}: {chosen.cols} x {chosen.rows} pixels of {chosen.pitch_um:g} um"
    return "\n".join([head, *(f"{what:<28}{number:>18}   {note}".rstrip() for what, number, note in rows)])


Row = tuple[str, str, str]


def _field(chosen: Design, budget: OpticalBudget) -> list[Row]:
    extent_px = budget.extent_mm * 1000 / chosen.pitch_um
    return [
        ("field of the light", f"{budget.field_deg:.1f} deg", f"{budget.retina_mm:.2f} mm on the retina"),
        ("LED cone for it", f"{budget.led_cone_deg:.2f} deg", "full angle; the cap sets it"),
        ("s, shift of its edge", f"{budget.half_shift_mm:.4f} mm", "on the sensor"),
        ("d + 2s", f"{budget.extent_mm:.3f} mm", f"{extent_px:.0f} px; an ideal relay: {budget.extent_tan_mm:.3f} mm"),
        *_side("long", budget.long, budget),
        *_side("short", budget.short, budget),
    ]


def _side(name: str, side: Side, budget: OpticalBudget) -> list[Row]:
    fits = "holds d + 2s" if side.sensor_mm > budget.extent_mm else "smaller than d + 2s: the frame is cropped"
    half = f"half of it at {side.half_caught_field_deg:.1f} deg"
    enough = "" if side.captured >= ENOUGH else "; too little"
    return [
        (f"{name} side of the sensor", f"{side.sensor_mm:.2f} mm", fits),
        ("  strict field", f"{side.strict_field_deg:.1f} deg", "by the paper's rule D > d + 2s"),
        ("  edge of the field keeps", f"{side.captured:.2f}", half + enough),
    ]


def _scale(chosen: Design, budget: OpticalBudget) -> list[Row]:
    return [
        ("scale", f"{budget.px_per_deg:.2f} px/deg", f"{60 / budget.px_per_deg:.2f} arcmin a pixel"),
        ("scale on the retina", f"{budget.retina_um_per_px:.1f} um/px", f"eye of {chosen.eye_mm:g} mm"),
    ]


def _eye(chosen: Design, budget: OpticalBudget) -> list[Row]:
    path = chosen.path.relay
    inside = "inside" if budget.ring_at_pupil_mm <= chosen.pupil_mm else "OUTSIDE"
    reflex = "clears" if budget.inner_ring_at_pupil_mm / 2 > budget.reflex_free_mm else "does not clear"
    ring = f"{budget.leds} LEDs, {inside} this pupil; {reflex} the cornea's reflex, {2 * budget.reflex_free_mm:.2f} mm"
    filled = f"the iris stays filled within {budget.filled_field_deg:.1f} deg"
    if budget.pupil_margin_mm < 0:
        filled = "this pupil never fills the iris"
    iris = f"of a pupil of {chosen.pupil_mm:g} mm"
    widest_mm = widest_iris_mm(chosen)
    if chosen.relay.iris_mm > widest_mm:
        iris += f"; TOO WIDE to be calibrated on this sensor, at most {widest_mm:.2f} mm at the diffuser"
    return [
        ("iris at the pupil", f"{budget.iris_at_eye_mm:.2f} mm", iris),
        ("pupil margin at the iris", f"{budget.pupil_margin_mm:.2f} mm", filled),
        ("ring at the pupil", f"{budget.ring_at_pupil_mm:.2f} mm", ring),
        ("first lens, clear", f"{budget.first_lens_mm:.1f} mm", _clear(budget.first_lens_mm, path.lens_mm)),
        ("beam at the splitter", f"{budget.splitter_mm:.1f} mm", _clear(budget.splitter_mm, path.splitter_mm / 2**0.5)),
    ]


def _clear(needed_mm: float, there_mm: float) -> str:
    return f"{'fits' if needed_mm <= there_mm else 'IS CUT BY'} the part's {there_mm:.1f} mm"


def _light(chosen: Design, budget: OpticalBudget) -> list[Row]:
    light = budget.light
    note = "photon-limited" if budget.within_simulated_range else "photon-limited; so little light was never simulated"
    if not budget.within_simulated_range and light.image_nw == 0:
        note = "no light of this ring passes the pupil"
    elif not budget.within_simulated_range and budget.electrons_per_px * (5.04 / chosen.pitch_um) ** 2 > 2e3:
        note = "photon-limited; so much light was never simulated"
    if chosen.optics.element.kind == "lenslets":
        note = "of a diffuser's picture; behind lenslets it is finer, and not known"
    known = "as measured" if chosen.measured else "a guess within a factor of two"
    inside = f"of it {chosen.share_in_pupil:.2f} in a pupil of {chosen.pupil_mm:g} mm"
    return [
        ("light at the cornea", f"{light.cornea_mw:.3f} mW", f"{chosen.colour}, full drive; {known}"),
        ("light on the retina", f"{light.retina_mw_per_cm2:.3f} mW/cm2", inside),
        ("light in the image", f"{light.image_nw:.2f} nW", "of a human fundus, through crossed polarisers"),
        (
            "electrons in a pixel",
            f"{budget.electrons_per_px:.0f} e-",
            f"in {1000 * chosen.exposure_s:g} ms,"
            f" {light.electrons_per_px_s:.0f} e-/s; quantum efficiency of the paper's sensor",
        ),
        ("expected half-period", f"{budget.half_period_um:.0f} um", f"{budget.half_period_deg:.2f} deg; {note}"),
    ]


def comparison() -> str:
    """Return the tables of OPTICS.md 1.2 and 1.5: extent of five fields on the sensor; sensors with three relays."""
    path = load_light_path(resources.LIGHT_PATH)
    relay = relay_of(path, path.optics)
    return "\n".join([*_extents(relay), "", *_sensors(path, relay)])


def _extents(relay: Relay) -> list[str]:
    pitch_um = known_sensors()["quantalux"].pitch_um
    lines = [f"{'field deg':>9} {'object mm':>10} {'s mm':>7} {'d + 2s mm':>10} {'px':>5} {'ideal relay mm':>15}"]
    for field in FIELDS_DEG:
        half_mm = half_shift_mm(relay, field)
        width_mm = extent_mm(relay, field)
        ideal_mm = relay.iris_mm + 2 * half_shift_tan_mm(relay, field)
        lines.append(
            f"{field:>9.1f} {size_mm(field, MODEL_EYE_MM):>10.3f} {half_mm:>7.4f} {width_mm:>10.3f}"
            f" {width_mm * 1000 / pitch_um:>5.0f} {ideal_mm:>15.3f}"
        )
    return lines


def _sensors(path: LightPath, relay: Relay) -> list[str]:
    small = replace(relay, iris_mm=relay.iris_mm / 2)
    variants = (relay, small, replace(small, diffuser_to_sensor_mm=relay.diffuser_to_sensor_mm * 2 / 3))
    titles = " ".join(f"{f'd {v.iris_mm:g}, z {v.diffuser_to_sensor_mm:g}':>13}" for v in variants)
    lines = [
        "strict field, long / short side of the sensor in deg, for iris d and distance z in mm",
        f"{'sensor':<10} {'mm':>13} {'px/deg':>7} {'um/px':>6} {titles} {'edge keeps':>11}",
    ]
    for name, sensor in known_sensors().items():
        budget = optical_budget(design_of_sensor(path, sensor))
        long_mm, short_mm = sensor.size_mm
        strict_deg = [(strict_field_deg(v, long_mm), strict_field_deg(v, short_mm)) for v in variants]
        fields = " ".join(f"{f'{long_deg:.1f} / {short_deg:.1f}':>13}" for long_deg, short_deg in strict_deg)
        lines.append(
            f"{name:<10} {f'{long_mm:.2f} x {short_mm:.2f}':>13} {budget.px_per_deg:>7.1f}"
            f" {budget.retina_um_per_px:>6.1f} {fields} {budget.short.captured:>11.2f}"
        )
    return lines
