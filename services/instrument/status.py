"""Status of the instrument as values: states and errors, readings of the chips, and interrupted captures.

The only module that reads the parts of the head for health checks and alerts. Reading a chip takes bus transfers, which
the driver serialises with those of the exam loop. It neither switches the lamp on nor changes a setting of the head.
"""

from collections.abc import Callable
from contextlib import suppress

from device.calibration.monitoring.finding import Finding
from device.calibration.monitoring.head_check import raise_on_failure
from device.errors import CalibrationError, DiffuscopeError, StoreError
from device.ports import Chips
from services.health.instrument_status import InstrumentStatus
from services.instrument.head_arbiter import HeadArbiter
from services.records.capture_journal import InterruptedCapture
from services.records.visit_repository import VisitRepository

DARK_POLL_S = 0.02


def read_status(arbiter: HeadArbiter) -> InstrumentStatus:
    """Return the present status; during a calibration the head is not read, and its readings are None."""
    head = arbiter.head
    exam = arbiter.owner.exam
    chips = head.chips if head is not None else Chips()
    bus = (head if head is not None else arbiter.context).spec.bus
    battery = chips.battery
    thermometer = chips.thermometer
    findings = arbiter.findings
    return InstrumentStatus(
        state=arbiter.owner.state,
        problem=arbiter.owner.problem,
        calibration_error=arbiter.owner.calibration_error or _calibration_failure(findings),
        findings=findings,
        battery=_reading(lambda: battery.read().fraction) if battery else None,
        emptiest=bus.emptiest if bus else 0.0,
        head_c=_reading(thermometer.read_c) if thermometer else None,
        warmest_c=bus.warmest_c if bus else 100.0,
        late_s=exam.progress.late_s if exam is not None else 0.0,
    )


def wait_until_dark(arbiter: HeadArbiter) -> bool:
    """Wait until the lamp is dark, and return True; return False if it stays lit for 2 `max_on_s`.

    During aiming the lamp is lit half of the time. True at once during a calibration.
    """
    head = arbiter.head
    clock = arbiter.context.clock
    begin_s = clock.now_s()
    while head is not None and head.light.illumination is not None:
        if clock.now_s() - begin_s > 2 * head.light.max_on_s:
            return False
        clock.sleep(DARK_POLL_S)
    return True


def interrupted_captures(arbiter: HeadArbiter, visits: VisitRepository) -> list[InterruptedCapture]:
    """Return the interrupted captures that have not been repeated; none during a calibration.

    Discards those whose slot has a newer capture or whose visit is finished. Test pictures are returned in one run of
    the instrument only.
    """
    exam = arbiter.owner.exam
    if exam is None:
        return []
    exam.capture_journal.discard(lambda capture: _is_over(capture, visits))
    with suppress(StoreError):  # then the next start reports the test pictures again
        exam.capture_journal.mark_reported()
    return list(exam.capture_journal.interrupted)


def _is_over(capture: InterruptedCapture, visits: VisitRepository) -> bool:
    """Return whether an interrupted capture needs no repetition.

    True if its slot has a newer capture or is unknown, or its visit is finished or unreadable; False without visit.
    """
    if capture.visit is None or capture.slot is None:
        return False
    try:
        visit = visits.get(capture.visit)
    except DiffuscopeError:
        return True
    slot = visit.slots.get(capture.slot)
    return visit.finished_at is not None or slot is None or len(slot.captures) > capture.tries


def _reading(read: Callable[[], float]) -> DiffuscopeError | float:
    """Return the result of `read`, or the DiffuscopeError that it raises."""
    try:
        return read()
    except DiffuscopeError as error:
        return error


def _calibration_failure(findings: tuple[Finding, ...]) -> DiffuscopeError | None:
    """Return the error of a finding that forbids captures; None if there is none."""
    try:
        raise_on_failure(findings)
    except CalibrationError as error:
        return error
    return None
