"""The guard around any lamp, real or simulated: dark by default, never lit for longer or brighter than an eye may.

The eye is counted before it is lit: the dose of the longest time that the lamp may shine is reserved in the ledger,
and given back down to what was really given once it is dark. Whoever dies in between has spent all of it.
"""

from collections.abc import Sequence
from contextlib import suppress
from math import ceil
from threading import Timer
from types import TracebackType

from device.clock import Clock
from device.dose import Hazard
from device.errors import LightCut, LightLimit, StoreError
from device.ledger import Ledger, Reserved
from device.ports import Light, Lit
from device.values import EYES, Eye, Glow

AFTERGLOW_S = 2.0  # a lamp whose process is killed is dark by the guardian in 0.1 s, and by its hardware gate in this


class GuardedLight:
    """A Light that holds `max_on_s` per stretch and leaves as much darkness as light before the next long one.

    A timer of its own darkens the lamp if the holder hangs: software above the light may fail, the eye must not pay.
    """

    def __init__(self, light: Light, clock: Clock, max_on_s: float, hazard: Hazard, ledger: Ledger) -> None:
        self._light, self._clock, self.max_on_s = light, clock, max_on_s
        self.hazard, self.ledger = hazard, ledger
        self.given_j_per_cm2 = 0.0  # by the last stretch of light
        self._timer: Timer | None = None
        self._held: Lit | None = None
        self._reserved: Reserved | None = None
        self._lit_at_s = 0.0
        self._debt_s = 0.0  # seconds of light that have not yet been matched by darkness
        self._dark_at_s = clock.now_s()
        self._late = False  # the timer has struck
        self._cut_at_s: float | None = None  # when it had ended this stretch
        light.off()

    @property
    def glow(self) -> Glow | None:
        """What the lamp shows now; None once it may shine no longer, for others may have darkened it meanwhile.

        A process that was stopped wakes up with a lamp that its guardian has cut, and does not know it.
        """
        if self._held is not None and self._clock.now_s() - self._lit_at_s >= self.max_on_s:
            return None
        return self._light.glow

    def on(self, glow: Glow, eyes: Sequence[Eye] = EYES) -> Lit:
        """Shine from the entry of the returned context to its end; LightLimit if the eye needs darkness first.

        The dose counts for `eyes`: for both while nobody knows which one looks. StoreError if it cannot be written.
        """
        return _Holding(self, glow, eyes)

    def account(self) -> dict[str, object]:
        """What a picture's report says of its light: its own dose, and what each eye has had in the last 24 h."""
        limits, eyes = self.hazard.limits, {eye: self.ledger.spent_j_per_cm2(eye) for eye in EYES}
        return {
            "dose_j_per_cm2": self.given_j_per_cm2,
            "dose_24h_j_per_cm2": eyes,
            "dose_stop_j_per_cm2": limits.stop_j_per_cm2,
            "dose_high": [eye for eye, spent in eyes.items() if spent > limits.warn_j_per_cm2],
        }

    def shine(self, glow: Glow, eyes: Sequence[Eye]) -> None:
        """Light up for the holder, and start the timer that ends it; one holder at a time."""
        now_s = self._clock.now_s()
        if self._held is not None:
            raise LightLimit("the lamp is already lit by someone else")
        self._debt_s, self._dark_at_s = max(0.0, self._debt_s - (now_s - self._dark_at_s)), now_s  # counts once
        if self._debt_s >= self.max_on_s:
            wait_s = max(1, ceil(self._debt_s - self.max_on_s))
            message = f"{self._debt_s:.1f} s of light have not yet been followed by darkness"
            raise LightLimit(message, f"Wait {wait_s} s, then press again.", wait_s=wait_s)
        self._reserve(glow, eyes)
        self._glow, self._lit_at_s, self._cut_at_s, self._late = glow, self._clock.now_s(), None, False
        self._held = self._light.on(glow)
        self._timer = Timer(self.max_on_s, self._cut)
        self._timer.daemon = True
        self._timer.start()
        self._held.__enter__()
        if self._late:  # the timer came before the light, and nothing else would end it
            raise LightCut(f"the lamp took longer to light up than the {self.max_on_s:g} s it may shine")

    def _reserve(self, glow: Glow, eyes: Sequence[Eye]) -> None:
        """Count the most that this stretch can give, on the disk, while it is still dark."""
        self.hazard.refuse(glow)
        most_j_per_cm2 = self.hazard.dose_j_per_cm2(glow, self.max_on_s + AFTERGLOW_S)
        self._reserved = self.ledger.reserve(eyes, most_j_per_cm2, self.hazard.limits.stop_j_per_cm2)

    def _cut(self) -> None:
        """The timer's own: be dark, whatever the holder does."""
        self._late = True
        self._light.off()
        self._cut_at_s = self._clock.now_s()

    def off(self) -> None:
        """Be dark now; the dose is settled once it is."""
        self._light.off()
        if self._timer is not None:
            self._timer.cancel()
        reserved, self._reserved = self._reserved, None
        if reserved is None:
            return
        given_s = 0.0
        if self._held is not None:
            self._held = None
            self._dark_at_s = self._clock.now_s() if self._cut_at_s is None else self._cut_at_s
            given_s = self._dark_at_s - self._lit_at_s
            self._debt_s += given_s
        self.given_j_per_cm2 = self.hazard.dose_j_per_cm2(self._glow, given_s)
        with suppress(StoreError):  # then all that was reserved stays counted, and the next light is refused
            self.ledger.settle(reserved, self.given_j_per_cm2)


class _Holding:
    """The lamp is on between the entry and the end of this context."""

    def __init__(self, light: GuardedLight, glow: Glow, eyes: Sequence[Eye]) -> None:
        self._light, self._glow, self._eyes = light, glow, eyes

    def __enter__(self) -> "_Holding":
        try:
            self._light.shine(self._glow, self._eyes)
        except BaseException:
            self._light.off()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._light.off()
