"""`python -m tests.hard`, which `diffuscope hard` starts: the grid of hard cases with its report."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from services.cli import main
from tests.hard import grid
from tests.hard.cells import COLUMNS

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def hard(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for hard-cases.json, .md and pictures.")],
    case: Annotated[list[str] | None, typer.Option(help="Just this row; may be repeated.")] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(help="Just this column: ladder (as shipped), a method, LenslessPiCam; may be repeated."),
    ] = None,
    merged: Annotated[int, typer.Option(min=1, max=4, help="Make n x n pixels one: quicker, a little coarser.")] = 1,
    drawn: Annotated[int, typer.Option(min=0, help="Of so many drawn eyes, instead of the three of the table.")] = 0,
    lenslets: Annotated[bool, typer.Option("--lenslets", help="Of eyes behind lenslets, instead.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A few rows of one eye in large pixels, in a minute.")] = False,
    check: Annotated[bool, typer.Option("--check", help="The exit status is 1 if there is a violation.")] = False,
) -> None:
    """Run the grid of hard cases: every kind of bad frame through every method and the default schedule."""
    if quick:
        merged, case, method = grid.QUICK_MERGED, case or [*grid.QUICK], method or [*grid.QUICK_COLUMNS]
    shown = grid.LENS_EYES if lenslets else grid.EYES
    asked = shown[:1] if quick else grid.drawn_eyes(drawn) or shown
    eyes = tuple(replace(eye, merged=merged) for eye in asked)
    found = grid.run(eyes, case or (), tuple(method or COLUMNS), lambda line: typer.echo(line, err=True))
    grid.write(output, found)
    typer.echo(grid.summary(found))
    typer.echo(f"{output}: hard-cases.json, hard-cases.md and a picture of each eye")
    if check and found.violations:
        raise typer.Exit(1)


if __name__ == "__main__":
    main(program=app, name="diffuscope hard")
