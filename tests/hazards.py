"""Controls of the hazards in `hardware/risk/hazards.toml`, and their tests."""

import tomllib
from functools import cache
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

FILE = Path(__file__).parents[1] / "hardware" / "risk" / "hazards.toml"


class Control(BaseModel):
    """A control, its tests (`FILE::FUNCTION`), and the make target that runs them."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    control: str
    target: str
    tests: tuple[str, ...] = Field(min_length=1)


class Hazard(BaseModel):
    """A hazard, the harm that it does, and its controls."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    id: str
    hazard: str
    harm: str
    controls: tuple[Control, ...] = Field(min_length=1)


class _Hazards(BaseModel):
    model_config = ConfigDict(extra="forbid")
    hazards: tuple[Hazard, ...]


@cache
def hazards() -> tuple[Hazard, ...]:
    """Return the hazards of the file."""
    return _Hazards.model_validate(tomllib.loads(FILE.read_text(encoding="utf-8"))).hazards


@cache
def control_tests() -> frozenset[str]:
    """Return the tests of all controls."""
    return frozenset(test for hazard in hazards() for control in hazard.controls for test in control.tests)
