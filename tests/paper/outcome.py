"""Result types of an experiment: claims with limits and labels, figures, tables and notes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from tests.paper.bench import Bench

Status = Literal["holds", "does not hold", "not reproduced"]
Label = Literal["as written", "adapted", "put in", "not reproduced", "ours"]


@dataclass(frozen=True)
class Claim:
    """One measured number with its limits, its status, its relation to the paper, and the paper's value.

    `attempted`: the statement is the paper's, and the simulation may miss it. Outside its limits it is reported as not
    reproduced: it does not count as held, and the run does not fail. `why`: how the paper's experiment was adapted,
    why the number is put in, or why it is not reproduced. `derived`: reason of the limit; empty if it was set after the
    value was seen.
    """

    what: str
    value: float
    limit: str
    holds: bool
    paper: str = ""
    digits: int = 3
    attempted: bool = False
    given_label: Label | None = None
    why: str = ""
    derived: str = ""

    def adapted(self, how: str) -> "Claim":
        """Return the claim, labelled as one on an adapted experiment."""
        return replace(self, given_label="adapted", why=how)

    def put_in(self, why: str) -> "Claim":
        """Return the claim, labelled as circular: its value was given to the simulation."""
        return replace(self, given_label="put in", why=why)

    def ours(self, why: str = "") -> "Claim":
        """Return the claim, labelled as one that the paper does not make."""
        return replace(self, given_label="ours", why=why)

    def because(self, why: str) -> "Claim":
        """Return the claim with a remark under its label: why it is not reproduced, or what it rests on."""
        return replace(self, why=why)

    def as_attempt(self) -> "Claim":
        """Return the claim as one on a statement of the paper, which the simulation may miss."""
        return replace(self, attempted=True)

    def limit_from(self, reason: str) -> "Claim":
        """Return the claim with the reason of its limit."""
        return replace(self, derived=reason)

    @property
    def label(self) -> Label:
        """Relation to the paper: by default "as written" if the paper says it, else "ours"."""
        if self.status == "not reproduced":
            return "not reproduced"
        return self.given_label or ("as written" if self.paper else "ours")

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
    """One experiment of the paper: key, title, one sentence, the paper's statement, and the function that runs it.

    `adapted`: how the experiment differs from the paper's; it labels every claim that the paper makes and that has no
    other label.
    """

    key: str
    title: str
    sentence: str
    paper: str
    run: Callable[[Bench], Outcome]
    adapted: str = ""

    def labelled(self, outcome: Outcome) -> Outcome:
        """Return an outcome of this experiment with its claims labelled."""
        if not self.adapted:
            return outcome
        claims = tuple(
            claim.adapted(self.adapted) if claim.label == "as written" else claim for claim in outcome.claims
        )
        return replace(outcome, claims=claims)


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
    return within(what, value, low, high, paper, digits).as_attempt()
