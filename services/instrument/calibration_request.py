"""Request for the calibration of one head, and the calibration job that follows from it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from math import degrees
from pathlib import Path

from device.calibration.archive import StoredCalibration
from device.calibration.led_radiometry import load_led_readings, missing_readings
from device.calibration.procedure.calibration_sequence import CalibrationJob
from device.config.head_file import InstrumentSpec
from device.errors import MemoryDamaged, SettingError
from device.head import Bench
from device.values import Colour, HeadIdentity

STEPS_FOLDER = ".steps"  # folder in the archive with the finished steps of an incomplete calibration
MODEL_EYE_MM = 25.0  # the paper's model eye
LONGEST_SERIAL = 64  # characters that fit into the memory of a head


@dataclass(frozen=True)
class CalibrationRequest:
    """Parameters of a calibration; None selects the value of the head or the default.

    `leds` is a file of LED radiometer readings; `CalibrationJob` describes the other fields.
    """

    archive: Path
    serial: str | None
    made_by: str
    source_deg: float | None = None
    eye_mm: float | None = None
    dioptres: bool = False
    colours: tuple[Colour, ...] = ()
    keep_raw: bool = False
    leds: Path | None = None
    source_mm: float | None = None
    faults: Mapping[str, str] = field(default_factory=dict)  # injected fault by stand, simulated heads only


def calibration_job(
    bench: Bench, spec: InstrumentSpec, request: CalibrationRequest, report: Callable[[str], None]
) -> CalibrationJob:
    """Return the calibration job of a request; call `report` with one sentence per colour with missing LED readings.

    Raises the errors of `serial_number`, SpecError for implausible LED readings.
    """
    leds = load_led_readings(request.leds, spec) if request.leds is not None else None
    for line in missing_readings(leds, spec) if leds is not None else ():
        report(line)
    identity = serial_number(bench, request), request.made_by, version("diffuscope")
    return CalibrationJob(
        spec,
        *identity,
        source_diameter_deg(spec, request),
        _eye_mm(spec, request),
        request.dioptres,
        request.colours,
        request.keep_raw,
        leds,
        _source_mm(spec, request),
    )


def write_identity(bench: Bench, kept: StoredCalibration) -> None:
    """Write serial number and calibration id into the memory of the head, if it has one."""
    if bench.chips.memory is not None:
        bench.chips.memory.write(HeadIdentity(kept.provenance.serial, kept.calibration.id))


def serial_number(bench: Bench, request: CalibrationRequest) -> str:
    """Return the serial number of the request, else of the head's memory, else `simulated` for a simulated head.

    Raises SettingError if it is missing or invalid, BusFault if the memory does not answer, MemoryDamaged if the
    memory is damaged and the request has no serial number.
    """
    try:
        stored = bench.chips.memory.read() if bench.chips.memory is not None else None
    except MemoryDamaged:
        if request.serial is None:
            raise
        stored = None  # damaged by a power cut; the calibration writes it again
    if request.serial is not None:
        if not 0 < len(request.serial) <= LONGEST_SERIAL or not request.serial.isprintable():
            raise SettingError(f"{request.serial!r} is no serial number", "Give one short line with --serial.")
        return request.serial
    if stored is not None:
        return stored.serial
    if bench.is_simulated:
        return "simulated"
    raise SettingError("this head does not say who it is", "Give its serial number with --serial.")


def source_diameter_deg(spec: InstrumentSpec, request: CalibrationRequest) -> float:
    """Return the angular diameter of the point source from the request, else the simulator, degrees; 0.0 if unknown."""
    if request.source_deg is not None or spec.sim is None:
        return request.source_deg or 0.0
    return degrees(spec.sim.calibration.source_um / spec.sim.eye.focal_length_um)


def _source_mm(spec: InstrumentSpec, request: CalibrationRequest) -> float | None:
    """Return the stated distance of the point source, mm; a simulated one is in focus; None if it is unknown."""
    return _eye_mm(spec, request) if request.source_mm is None and spec.sim is not None else request.source_mm


def _eye_mm(spec: InstrumentSpec, request: CalibrationRequest) -> float:
    if request.eye_mm is not None or spec.sim is None:
        return request.eye_mm or MODEL_EYE_MM
    return spec.sim.eye.focal_length_um / 1000
