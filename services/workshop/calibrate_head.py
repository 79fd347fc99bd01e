"""`diffuscope calibrate`: calibration of one head, with a technician or the simulator as the operator."""

from collections.abc import Callable, Mapping
from contextlib import closing

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.procedure.calibration_sequence import (
    AXIAL_OFFSETS_MM,
    COLOUR_TARGETS,
    CalibrationSequence,
    CalibrationTarget,
    Operator,
)
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import SettingError
from device.head import Bench, open_bench
from services.instrument.calibration_request import STEPS_FOLDER, CalibrationRequest, calibration_job, write_identity
from services.workshop.calibration_words import ZERO_WORDS

ASKED: dict[CalibrationTarget, str] = {
    "cap": "Put the cap on the head and shade it.",
    "screen": "Take the camera off the diffuser cell and lay it on the even screen, switched on, nothing between.",
    "point": "Screen off, camera back onto its cell; put the point source before the head, on its axis.",
    **{
        stand: f"Move the point source along the axis to {moved_mm:+g} mm ({way} the lens) of where it was first."
        for stand, moved_mm in AXIAL_OFFSETS_MM.items()
        for way in ["away from" if moved_mm > 0 else "towards"]
    },
    **{
        stand: f"Put the point source back where it was first, and let it shine in {c}."
        for c, stand in COLOUR_TARGETS.items()
    },
}


def calibrate(
    spec: InstrumentSpec,
    request: CalibrationRequest,
    clock: Clock,
    ask: Callable[[str], None],
    progress: Callable[[str], None],
) -> StoredCalibration:
    """Measure a head and activate its calibration; steps completed before an earlier error are not measured again.

    `ask` prompts the operator to place a target before the head and returns once the target is there. `progress` is
    called with one line per step. SettingError for faults requested of a real head.
    """
    with closing(open_bench(spec, clock)) as bench:
        if request.faults and not bench.is_simulated:
            raise SettingError("nothing goes wrong on purpose on a real head", "Leave out --mishap.")
        place = with_faults(bench, request.faults) if bench.is_simulated else lambda stand: ask(ASKED[stand])
        return calibrate_on(bench, spec, request, clock, Operator(place, progress))


def measured_values(kept: StoredCalibration) -> tuple[str, ...]:
    """Return lines with the measured values of the sensor, the other figures of a calibration, and its zero."""
    sensor = kept.calibration.sensor
    figures = ", ".join(f"{k} {v:.3g}" for k, v in kept.provenance.figures)
    return (
        f"black {sensor.black_dn:.2f} DN, gain {sensor.gain_e_per_dn:.3f} e-/DN, white {sensor.white_dn:.0f} DN",
        f"read noise {sensor.read_noise_e:.2f} e-, {figures}",
        f"zero of the refraction: {ZERO_WORDS[kept.calibration.refraction_zero]}",
    )


def calibrate_on(
    bench: Bench, spec: InstrumentSpec, request: CalibrationRequest, clock: Clock, operator: Operator
) -> StoredCalibration:
    """Calibrate an open head and return the stored calibration; the head's memory is written last.

    After a power cut before that write, the instrument refuses to start and names the command that writes the memory.
    """
    job = calibration_job(bench, spec, request, operator.show_message)
    work = request.archive / STEPS_FOLDER
    procedure = CalibrationSequence(job, bench.camera, operator, clock, work, bench.chips.thermometer)
    archive = Archive(request.archive)
    kept = archive.load(procedure.run(archive))
    write_identity(bench, kept)
    return kept


def with_faults(bench: Bench, mishaps: Mapping[str, str]) -> Callable[[CalibrationTarget], None]:
    """Return a callback that places targets before a simulated head, with a fault for some.

    `mishaps` maps a target to the name of its fault. SettingError for a target that no step uses.
    """
    if unknown := set(mishaps) - set(ASKED):
        raise SettingError(f"no step wants {sorted(unknown)[0]!r}", f"Choose from {', '.join(ASKED)}.")

    def place_with_fault(stand: CalibrationTarget) -> None:
        bench.place_target(stand)
        if stand in mishaps:
            bench.inject_fault(mishaps[stand])

    return place_with_fault
