"""State of the running instrument as values, for health checks and alerts.

`services/health` is a lower layer than `services/instrument` and imports nothing from it; the values are read in
services/instrument/status.py.
"""

from dataclasses import dataclass

from device.calibration.monitoring.finding import Finding
from device.errors import DiffuscopeError


@dataclass(frozen=True)
class InstrumentStatus:
    """State of the instrument at one moment.

    `state`: `starting`, `aim`, `making` or `busy`; `busy` during a calibration. `problem`: error that prevents captures
    now. `calibration_error`: error of the calibration that forbids captures. `findings`: of the calibration monitor.
    `battery` (charge, 0 to 1) and `head_c`: the reading, its error, or None without such a chip and during a
    calibration; `emptiest` and `warmest_c` are their limits. `late_s`: seconds by which the oldest capture in progress
    exceeds its time budget.
    """

    state: str
    problem: DiffuscopeError | None
    calibration_error: DiffuscopeError | None
    findings: tuple[Finding, ...]
    battery: DiffuscopeError | float | None
    emptiest: float
    head_c: DiffuscopeError | float | None
    warmest_c: float
    late_s: float
