"""Light guard around any lamp, real or simulated: dark by default, with limits on duration, irradiance and dose.

A stretch of light runs from switching on to switching off. Its dose is counted before the light: the ledger reserves
the dose of the longest permitted stretch, and the reservation is reduced to the delivered dose once the lamp is dark.
If the process dies in between, the whole reservation counts.
"""

from collections.abc import Sequence
from contextlib import suppress
from math import ceil
from threading import Timer
from types import TracebackType

from device.clock import Clock
from device.errors import LightCut, LightLimit, LightWithoutVisit, StoreError
from device.light_safety.dose_ledger import Ledger, Reserved
from device.light_safety.dose_report import DoseReport
from device.light_safety.hazard import Hazard
from device.ports import Light, LightContext
from device.values import EYES, Eye, Illumination

LIT_AFTER_KILL_S = 2.0  # after a kill the guardian darkens the lamp in 0.1 s, the hardware gate within this time


class GuardedLight:
    """Guarded light: a timer ends each stretch of light after `max_on_s`, also if the holder hangs.

    No stretch may begin while `max_on_s` or more of earlier light has not yet been followed by an equal time of
    darkness.
    """

    def __init__(self, light: Light, clock: Clock, max_on_s: float, hazard: Hazard, ledger: Ledger) -> None:
        self._light = light
        self._clock = clock
        self.max_on_s = max_on_s
        self.hazard = hazard
        self.ledger = ledger
        self.given_j_per_cm2 = 0.0  # dose of the last stretch of light
        self.total_j_per_cm2 = 0.0  # dose of all stretches of light that are over
        self._timer: Timer | None = None
        self._held: LightContext | None = None
        self._reserved: Reserved | None = None
        self._lit_at_s = 0.0
        self._debt_s = 0.0  # seconds of light not yet followed by darkness
        self._dark_at_s = clock.now_s()
        self._late = False  # the timer has fired
        self._cut_at_s: float | None = None  # when it had ended this stretch
        light.off()

    @property
    def illumination(self) -> Illumination | None:
        """Return the current illumination; None if off, or once `max_on_s` has passed since the lamp was turned on.

        After that time the lamp may be dark although this process has not turned it off: if this process was stopped
        meanwhile, the guardian process has done so.
        """
        if self._held is not None and self._clock.now_s() - self._lit_at_s >= self.max_on_s:
            return None
        return self._light.illumination

    @property
    def on_since_s(self) -> float | None:
        """Return when the running stretch of light began (clock seconds); None while the lamp is dark."""
        return None if self._held is None else self._lit_at_s

    @property
    def running_j_per_cm2(self) -> float:
        """Return the dose of the running stretch of light until now; 0.0 while the lamp is dark."""
        if self._held is None:
            return 0.0
        return self.hazard.dose_j_per_cm2(self._illumination, self._clock.now_s() - self._lit_at_s)

    def on(self, illumination: Illumination, eyes: Sequence[Eye] = EYES, *, in_visit: bool = False) -> LightContext:
        """Return a context with the lamp on from entry to exit; its dose counts for `eyes`.

        By default for both: it may be unknown which eye is in front of the head. Light that belongs to no visit
        (`in_visit` False) has a lower limit of dose. Errors on entry, with the lamp off: LightLimit (already on,
        darkness due, or a limit of irradiance or dose), StoreError of the ledger, LightFault.
        """
        return _Holding(self, illumination, eyes, in_visit)

    def dose_report(self) -> DoseReport:
        """Return the light figures of a report, J/cm2: last dose, dose by eye in 24 h, limit, eyes above warning."""
        limits = self.hazard.limits
        eyes: dict[str, float] = {eye: self.ledger.spent_j_per_cm2(eye) for eye in EYES}
        return DoseReport(
            dose_j_per_cm2=self.given_j_per_cm2,
            dose_24h_j_per_cm2=eyes,
            dose_stop_j_per_cm2=limits.stop_j_per_cm2,
            dose_high=tuple(eye for eye, spent in eyes.items() if spent > limits.warn_j_per_cm2),
            limits_unchecked=limits.unchecked,
        )

    def turn_on(self, illumination: Illumination, eyes: Sequence[Eye], in_visit: bool) -> None:
        """Turn the lamp on and start its timer; LightLimit if it is on, darkness is due or a limit is exceeded."""
        now_s = self._clock.now_s()
        if self._held is not None:
            raise LightLimit("the lamp is already lit by someone else")
        self._debt_s = max(0.0, self._debt_s - (now_s - self._dark_at_s))
        self._dark_at_s = now_s  # counts once
        if self._debt_s >= self.max_on_s:
            wait_s = max(1, ceil(self._debt_s - self.max_on_s))
            message = f"{self._debt_s:.1f} s of light have not yet been followed by darkness"
            raise LightLimit(message, f"Wait {wait_s} s, then press again.", wait_s=wait_s)
        self._reserve(illumination, eyes, in_visit)
        self._illumination = illumination
        self._lit_at_s = self._clock.now_s()
        self._cut_at_s = None
        self._late = False
        self._held = self._light.on(illumination)
        self._timer = Timer(self.max_on_s, self.cut)
        self._timer.daemon = True
        self._timer.start()
        self._held.__enter__()
        if self._late:  # the timer fired before the lamp was on: nothing else would end the light
            raise LightCut(f"the lamp took longer to light up than the {self.max_on_s:g} s it may shine")

    def _reserve(self, illumination: Illumination, eyes: Sequence[Eye], in_visit: bool) -> None:
        """Reserve the largest dose of this stretch, before the lamp is on; LightLimit if it is not permitted.

        LightWithoutVisit if the dose would be permitted in a visit.
        """
        self.hazard.refuse(illumination)
        most_j_per_cm2 = self.hazard.dose_j_per_cm2(illumination, self.max_on_s + LIT_AFTER_KILL_S)
        limits = self.hazard.limits
        stop_j_per_cm2 = limits.stop_j_per_cm2 if in_visit else limits.stop_without_visit_j_per_cm2
        try:
            self._reserved = self.ledger.reserve(eyes, most_j_per_cm2, stop_j_per_cm2)
        except LightLimit as error:
            total_j_per_cm2 = most_j_per_cm2 + max(self.ledger.spent_j_per_cm2(eye) for eye in eyes)
            if in_visit or total_j_per_cm2 > limits.stop_j_per_cm2:
                raise
            raise LightWithoutVisit(f"without a visit: {error.message}", n=error.n) from error

    def cut(self) -> None:
        """Turn the lamp off at the end of the permitted time; called by the timer."""
        self._late = True
        self._light.off()
        self._cut_at_s = self._clock.now_s()

    def off(self) -> None:
        """Turn the lamp off, then replace the reserved dose in the ledger by the delivered dose; harmless if off."""
        self._light.off()
        if self._timer is not None:
            self._timer.cancel()
        reserved = self._reserved
        self._reserved = None
        if reserved is None:
            return
        given_s = 0.0
        if self._held is not None:
            self._held = None
            self._dark_at_s = self._clock.now_s() if self._cut_at_s is None else self._cut_at_s
            given_s = self._dark_at_s - self._lit_at_s
            self._debt_s += given_s
        self.given_j_per_cm2 = self.hazard.dose_j_per_cm2(self._illumination, given_s)
        self.total_j_per_cm2 += self.given_j_per_cm2
        with suppress(StoreError):  # the whole reservation stays counted, and the next light is refused
            self.ledger.settle(reserved, self.given_j_per_cm2)


class _Holding:
    """Context of one stretch: the lamp is on from entry to exit, and off after an error on entry."""

    def __init__(self, light: GuardedLight, illumination: Illumination, eyes: Sequence[Eye], in_visit: bool) -> None:
        self._light = light
        self._illumination = illumination
        self._eyes = eyes
        self._in_visit = in_visit

    def __enter__(self) -> "_Holding":
        try:
            self._light.turn_on(self._illumination, self._eyes, self._in_visit)
        except BaseException:
            self._light.off()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._light.off()
