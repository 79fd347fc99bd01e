"""Measured frontier of accuracy and time, as stored in `frontier.json` and shown on the page."""

from pydantic import BaseModel, ConfigDict, Field, JsonValue


class _StoredPart(BaseModel):
    """Part of the stored measurement; entries that the program does not read are kept."""

    model_config = ConfigDict(frozen=True, extra="allow")
    __pydantic_extra__: dict[str, JsonValue]


class MeasuredPoint(_StoredPart):
    """One method, bin and number of rounds, with its median time in seconds and its PSNR in dB.

    `pareto`: no other point is at least as fast and at least as accurate, and better in one of both.
    """

    method: str
    bin: int
    rounds: int
    seconds_median: float
    psnr_db: float
    pareto: bool


class MeasuredFrontier(_StoredPart):
    """Points of one scene and the time budget in seconds; `measured_at`: ISO 8601, absent before it is stored."""

    scene: str
    budget_s: float
    points: tuple[MeasuredPoint, ...]
    measured_at: str | None = Field(default=None, exclude_if=lambda value: value is None)
