"""Command `diffuscope programme check`: check a programme file before it is used."""

from pathlib import Path
from typing import Annotated

import typer

from services.records.programme import load_programme
from services.running_time import announced

app = typer.Typer(help="The file that says what a screening consists of.", no_args_is_help=True)


@app.callback()
def root() -> None:
    """The file that says what a screening consists of."""  # with a callback, `check` stays a command of its own


@app.command()
@announced("checking the programme")
def check(file: Annotated[Path, typer.Argument(help="Programme file, as TOML.")]) -> None:
    """Check a programme file: the exit status is 2 for a mistake, with its line and key."""
    programme = load_programme(file)
    slots = ", ".join(f"{slot.id} ({slot.eye}{'' if slot.required else ', optional'})" for slot in programme.slots)
    typer.echo(f"{file}: valid, version {programme.version}")
    typer.echo(f"pictures: {slots}; at most {programme.retakes} retakes of each, {programme.frames} frames")
    typer.echo(
        f"referral: vision below {programme.referral.vision_limit}; numbers begin with {programme.numbers.prefix}"
    )
    rules = programme.retention.model_dump(exclude_none=True)
    kept = ", ".join(f"{rule.removesuffix('_days')} {days}" for rule, days in rules.items())
    typer.echo(f"retention, in days after the last visit: {kept or 'no rule'}")
    typer.echo(f"exports: encrypted to {', '.join(programme.exports.recipients) or 'no key, plain'}")
