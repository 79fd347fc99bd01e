"""Result of one calibration check: a value with its limit and a remedy."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One checked quantity: value, limit, unit, whether it is within the limit (`ok`), and the remedy (empty if none).

    `hint`: the limit is exceeded, but pictures remain valid and may be taken; the finding informs the operator only.
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
        """Return whether this finding forbids pictures with this calibration: not ok, and more than a hint."""
        return not self.ok and not self.hint
