"""`diffuscope meter`: light the ring for a power meter within the light guard's limits, and judge the meter's reading.

    run_of            what shines, in which pulses, and the powers to compare a reading with
    give_pulses       the light itself, behind guard, dose ledger, guardian process and hardware gate
    judge_reading     GO or NO GO for one reading

The guard ends each stretch of light after `max_on_s` and then asks for as much darkness, and this command has no way
around it. So the light is a train of pulses of 0.8 `max_on_s` with equal pauses: a photodiode settles within a pulse,
and a slow meter shows half.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from pathlib import Path

from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.config.radiometry import LED_FWHM_UM
from device.errors import SettingError
from device.head import hazard_of, open_light, refuse_without_lamp, with_calibrated_light
from device.light_safety.dose_ledger import Ledger
from device.light_safety.hazard import LED_POWER_UNCERTAINTY, light_limits
from device.values import Illumination
from services.identity.audit_key import find_audit_key
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_tables import DoseLedgerStore
from services.workshop.light_report import AXIS_DISTANCE_MM, AXIS_HOLE_MM, AXIS_HOLE_SR, GUARD, expected_uw
from services.workshop.optics_report import design_of

ON_SHARE = 0.8  # of max_on_s: a pulse ends before the guard's timer does
DUTY = 0.5
LAMP_OFF_SHARE = 1e-3  # of the expected power: below, the meter saw no lamp


@dataclass(frozen=True)
class MeterRun:
    """What shines in pulses of `on_s` with equal pauses, and powers behind the hole on the axis while it is lit, uW.

    `expected_uw` is that of the light budget. No reading may exceed `assumed_uw`, which the guard counts for this
    level, or `permitted_uw`, at which an eye would receive the instrument's limit (LEDs' spectrum, factor of 1.3 for
    the meter's error).
    """

    spec: InstrumentSpec
    illumination: Illumination
    on_s: float
    count: int
    expected_uw: float
    assumed_uw: float
    permitted_uw: float


@dataclass(frozen=True)
class MeterVerdict:
    """Reading while the ring is lit, uW, and whether it is one with which an eye could be lit at this level."""

    axis_uw: float
    is_go: bool


def run_of(spec: InstrumentSpec, level: float | None, seconds: float) -> MeterRun:
    """Return a run in the head's picture colour of at least `seconds`; `level` None: the highest that is permitted.

    LightLimit for a level above a limit of irradiance, SpecError for a head without LEDs or not of that colour.
    """
    refuse_without_lamp(spec)
    spec = with_calibrated_light(spec)
    design = design_of(spec)
    hazard = hazard_of(spec)
    colour = spec.light.colour
    illumination = hazard.brightest(colour) if level is None else Illumination(colour, level)
    hazard.refuse(illumination)
    limits = hazard.limits
    beam = hazard.beams[colour]
    spectrum = beam.wavelength_um, beam.fwhm_um or LED_FWHM_UM
    most_w_per_cm2 = min(
        limits.photochemical_w_per_cm2 / limits.photochemical_weight.of_spectrum(*spectrum),
        limits.thermal_w_per_cm2 / limits.thermal_weight.of_spectrum(*spectrum),
    )
    uw_per_w_per_cm2 = 1e6 * (design.path.eye.focal_mm / 10) ** 2 * AXIS_HOLE_SR  # I = E f^2, into the hole
    on_s = ON_SHARE * spec.light.max_on_s
    return MeterRun(
        spec,
        illumination,
        on_s,
        ceil(seconds * DUTY / on_s),
        expected_uw=illumination.level * expected_uw(design),
        assumed_uw=illumination.level * uw_per_w_per_cm2 * beam.retina_w_per_cm2,
        permitted_uw=uw_per_w_per_cm2 * most_w_per_cm2 / GUARD,
    )


def give_pulses(run: MeterRun, data: Path, clock: Clock, progress: Callable[[str], None]) -> None:
    """Light the ring as planned; its dose counts for both eyes in the ledger of `data`, as if one had been there.

    Errors of the store, the guard and the lamp, which is then dark.
    """
    with CaptureStore(data, clock=clock, key=find_audit_key(data)) as store:
        pulse(run, DoseLedgerStore(store.engine, clock, light_limits().window_s), clock, progress)


def pulse(run: MeterRun, ledger: Ledger, clock: Clock, progress: Callable[[str], None]) -> None:
    """Light the ring as planned, with the dose in `ledger`."""
    with open_light(run.spec, clock, ledger) as light:
        for number in range(1, run.count + 1):
            begin_s = clock.now_s()
            with light.on(run.illumination):
                progress(f"pulse {number} of {run.count}")
                clock.sleep(run.on_s)
            clock.sleep(clock.now_s() - begin_s)  # as long as the lamp took in fact: no light is left to repay


def judge_reading(run: MeterRun, shown_uw: float, *, peak: bool = False) -> MeterVerdict:
    """Return the judgement of a meter's reading, uW; `peak`: it is that while the ring is lit, else the mean.

    The mean over pulses and pauses is half of it: what a slow meter shows must not pass for the whole. SettingError for
    a reading of a lamp that was off.
    """
    axis_uw = shown_uw if peak else shown_uw / DUTY
    if axis_uw <= LAMP_OFF_SHARE * run.expected_uw:
        raise SettingError(
            f"{shown_uw:g} uW is no light: {run.expected_uw:.2g} uW are expected",
            "Check that the meter stands in the beam, its range and wavelength, and that the gate has power.",
        )
    return MeterVerdict(axis_uw, axis_uw <= min(run.assumed_uw, run.permitted_uw))


def announcement(run: MeterRun) -> str:
    """Return what will shine, and what the meter should show."""
    return "\n".join(
        [
            f"{run.spec.name}: {run.illumination.colour} at {run.illumination.level:g} of full drive, "
            f"{run.count} pulses of {run.on_s:g} s with equal pauses",
            f"through a hole of {AXIS_HOLE_MM:g} mm on the axis, {AXIS_DISTANCE_MM:g} mm behind the eye's pupil, where "
            "the reading is highest; nothing stands in the pupil:",
            f"expected {run.expected_uw:.3g} uW within a factor of two; the guard counts {run.assumed_uw:.3g} uW; "
            f"an eye may have {run.permitted_uw:.3g} uW",
        ]
    )


def words(head: Path, run: MeterRun, verdict: MeterVerdict) -> str:
    """Return GO or NO GO with the reason, and the command that judges the ring at full drive."""
    shown = f"{verdict.axis_uw:.3g} uW"
    if verdict.axis_uw > run.permitted_uw:
        return f"NO GO: {shown} are more than the {run.permitted_uw:.3g} uW that an eye may have"
    if not verdict.is_go:
        return (
            f"NO GO: {shown} are more than the {run.assumed_uw:.3g} uW that the guard counts for this level: "
            "the LEDs or [light.radiometry] are not those of the head file"
        )
    times = verdict.axis_uw / run.expected_uw
    usual = 1 / LED_POWER_UNCERTAINTY <= times <= LED_POWER_UNCERTAINTY
    return "\n".join(
        [
            f"GO at this level: {shown}, {times:.2g} times what is expected"
            + ("" if usual else "; look at polarisers, LEDs and the meter's place before you go on"),
            "Measure the brightest disc of 1 mm in the waist as well, and peak and width of the spectrum. Then:",
            f"diffuscope light --head {head} --colour {run.illumination.colour} --level {run.illumination.level:g} "
            f'--axis-uw {verdict.axis_uw:.4g} --waist-mw-per-cm2 W --peak-nm L --fwhm-nm B --meter "NAME, DATE"',
        ]
    )
