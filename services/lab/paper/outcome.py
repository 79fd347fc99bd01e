"""Result types of an experiment: claims with limits, figures, tables and notes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from services.lab.paper.bench import Bench

Status = Literal["holds", "does not hold", "not reproduced"]


@dataclass(frozen=True)
class Claim:
    """One measured number with its limits, its status and the paper's value.

    `attempted`: the number is the paper's, and the simulation may miss it. Outside its limits the number is reported as
    not reproduced: it does not count as held, and the run does not fail.
    """

    what: str
    value: float
    limit: str
    holds: bool
    paper: str = ""
    digits: int = 3
    attempted: bool = False

    @property
    def status(self) -> Status:
        """Status as printed in the report."""
        if self.holds:
            return "holds"
        return "not reproduced" if self.attempted else "does not hold"


@dataclass(frozen=True)
class Figure:
    """One picture (`address`: a data URL) with its caption; a `wide` one fills a row, one that `begins` starts a row.

    A picture with a `file` name is also written beside the report as PNG.
    """

    caption: str
    address: str
    wide: bool = False
    begins: bool = False
    file: str = ""


@dataclass(frozen=True)
class Table:
    """A small table: heading row and rows, as printed."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Outcome:
    """Result of one experiment; `notes` are sentences for the reader."""

    claims: tuple[Claim, ...]
    shown: tuple[Figure, ...] = ()
    sheets: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """One experiment of the paper: key, title, one sentence, the paper's statement, and the function that runs it."""

    key: str
    title: str
    sentence: str
    paper: str
    run: Callable[[Bench], Outcome]


def above(what: str, value: float, least: float, paper: str = "", digits: int = 3) -> Claim:
    """Return a claim that the value is larger than a limit."""
    return Claim(what, value, f"> {least:g}", value > least, paper, digits)


def below(what: str, value: float, most: float, paper: str = "", digits: int = 3) -> Claim:
    """Return a claim that the value is smaller than a limit."""
    return Claim(what, value, f"< {most:g}", value < most, paper, digits)


def within(what: str, value: float, low: float, high: float, paper: str = "", digits: int = 3) -> Claim:
    """Return a claim that the value lies between two limits, these included."""
    return Claim(what, value, f"{low:g} to {high:g}", low <= value <= high, paper, digits)


def attempted(what: str, value: float, low: float, high: float, paper: str, digits: int = 3) -> Claim:
    """Return a claim on a number of the paper; outside the limits the number is reported as not reproduced."""
    return Claim(what, value, f"{low:g} to {high:g}", low <= value <= high, paper, digits, attempted=True)
