"""What an experiment found: numbers with their limits, pictures, tables, and what has to be said beside them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from services.instrument.paper.bench import Bench

Status = Literal["holds", "does not hold", "not reproduced"]


@dataclass(frozen=True)
class Claim:
    """One number that could have come out otherwise: its limits, whether it keeps them, and what the paper printed.

    `attempted`: the number is the paper's, and it is known that the simulation may miss it. Outside its limits it is
    reported as not reproduced; it never counts as held then, and it does not make the run fail.
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
        """As the report prints it."""
        if self.holds:
            return "holds"
        return "not reproduced" if self.attempted else "does not hold"


@dataclass(frozen=True)
class Shown:
    """One picture with its caption, as a data address; a `wide` one fills a row, one that `begins` starts a row.

    One with the name of a `file` is also written beside the report, as PNG.
    """

    caption: str
    address: str
    wide: bool = False
    begins: bool = False
    file: str = ""


@dataclass(frozen=True)
class Sheet:
    """A small table: its heading row and its rows, as they are printed."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Outcome:
    """Everything that one experiment has to show; `notes` are sentences for the reader."""

    claims: tuple[Claim, ...]
    shown: tuple[Shown, ...] = ()
    sheets: tuple[Sheet, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """One experiment of the paper: its key, its title, one sentence, what the paper says of it, and how it is run."""

    key: str
    title: str
    sentence: str
    paper: str
    run: Callable[[Bench], Outcome]


def above(what: str, value: float, least: float, paper: str = "", digits: int = 3) -> Claim:
    """A number that must be larger than a limit."""
    return Claim(what, value, f"> {least:g}", value > least, paper, digits)


def below(what: str, value: float, most: float, paper: str = "", digits: int = 3) -> Claim:
    """A number that must be smaller than a limit."""
    return Claim(what, value, f"< {most:g}", value < most, paper, digits)


def within(what: str, value: float, low: float, high: float, paper: str = "", digits: int = 3) -> Claim:
    """A number that must lie between two limits."""
    return Claim(what, value, f"{low:g} to {high:g}", low <= value <= high, paper, digits)


def attempted(what: str, value: float, low: float, high: float, paper: str, digits: int = 3) -> Claim:
    """A number that the paper prints, which the simulation should come near: else it is not reproduced."""
    return Claim(what, value, f"{low:g} to {high:g}", low <= value <= high, paper, digits, attempted=True)
