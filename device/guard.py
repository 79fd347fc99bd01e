"""The guard around any lamp, real or simulated: dark by default, and never lit longer than it may be.

The full dose model comes later; this one already refuses, and already switches off by itself.
"""

from threading import Timer
from types import TracebackType

from device.clock import Clock
from device.errors import LightLimit
from device.ports import Light, Lit
from device.values import Glow


class GuardedLight:
    """A Light that holds `max_on_s` per stretch and leaves as much darkness as light before the next long one.

    A timer of its own darkens the lamp if the holder hangs: software above the light may fail, the eye must not pay.
    """

    def __init__(self, light: Light, clock: Clock, max_on_s: float) -> None:
        self._light, self._clock, self.max_on_s = light, clock, max_on_s
        self._timer: Timer | None = None
        self._held: Lit | None = None
        self._lit_at_s = 0.0
        self._debt_s = 0.0  # seconds of light that have not yet been matched by darkness
        self._dark_at_s = clock.now_s()
        self._cut_at_s: float | None = None  # when the timer ended this stretch, if it did
        light.off()

    @property
    def glow(self) -> Glow | None:
        """What the lamp shows now."""
        return self._light.glow

    def on(self, glow: Glow) -> Lit:
        """Shine from the entry of the returned context to its end; LightLimit if the eye needs darkness first."""
        return _Holding(self, glow)

    def shine(self, glow: Glow) -> None:
        """Light up for the holder, and start the timer that ends it; one holder at a time."""
        now_s = self._clock.now_s()
        if self._held is not None:
            raise LightLimit("the lamp is already lit by someone else")
        self._debt_s, self._dark_at_s = max(0.0, self._debt_s - (now_s - self._dark_at_s)), now_s  # counts once
        if self._debt_s >= self.max_on_s:
            raise LightLimit(f"{self._debt_s:.1f} s of light have not yet been followed by darkness")
        self._lit_at_s, self._cut_at_s = now_s, None
        self._timer = Timer(self.max_on_s, self._cut)
        self._timer.daemon = True
        self._timer.start()
        self._held = self._light.on(glow)
        self._held.__enter__()
        if self._cut_at_s is not None:  # the timer came before the light, and nothing else would end it
            raise LightLimit(f"the lamp took longer to light up than the {self.max_on_s:g} s it may shine")

    def _cut(self) -> None:
        """The timer's own: be dark, whatever the holder does."""
        self._cut_at_s = self._clock.now_s()
        self._light.off()

    def off(self) -> None:
        """Be dark now."""
        if self._timer is not None:
            self._timer.cancel()
        self._light.off()
        if self._held is not None:
            self._held = None
            self._dark_at_s = self._clock.now_s() if self._cut_at_s is None else self._cut_at_s
            self._debt_s += self._dark_at_s - self._lit_at_s


class _Holding:
    """The lamp is on between the entry and the end of this context."""

    def __init__(self, light: GuardedLight, glow: Glow) -> None:
        self._light, self._glow = light, glow

    def __enter__(self) -> "_Holding":
        try:
            self._light.shine(self._glow)
        except BaseException:
            self._light.off()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._light.off()
