"""One thing that was checked: its number beside its limit, and what to do."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """What was looked at, whether it is within its limit, in which unit, and the remedy (empty where none is needed).

    `hint`: beyond this limit pictures are still true, and may be taken; somebody should know.
    """

    name: str
    ok: bool
    value: float
    limit: float
    unit: str
    remedy: str = ""
    hint: bool = False

    @property
    def fails(self) -> bool:
        """Whether no picture should rest on this calibration."""
        return not self.ok and not self.hint
