"""Commands `diffuscope users add|reset|list`: the users of a data folder, without the page."""

from pathlib import Path
from typing import Annotated, cast

import typer

from device.user_files import read_text
from services.identity.users import FOLDER, ROLES, Role, UserTable
from services.running_time import announced

app = typer.Typer(help="Who may use the instrument, and what each may do.", no_args_is_help=True)
Data = Annotated[Path, typer.Option(help="Where captures are kept.")]
Name = Annotated[str, typer.Argument(help="Name with which the user signs in.")]
SecretFile = Annotated[
    Path | None, typer.Option(help="File with the PIN or passphrase in its first line, instead of a question.")
]


@app.command()
def add(
    name: Name,
    role: Annotated[list[str], typer.Option(help=f"One of {', '.join(ROLES)}; again for several.")],
    data: Data,
    secret_file: SecretFile = None,
) -> None:
    """Add a user; the first one must be an administrator. It ends the demonstration user of a simulated head."""
    if unknown := [one for one in role if one not in ROLES]:
        raise typer.BadParameter(f"{unknown[0]} is no role; choose from {', '.join(ROLES)}")
    user = UserTable(data / FOLDER).add(name, _secret(secret_file), cast(list[Role], role))
    typer.echo(f"{user.name} may sign in now as {', '.join(sorted(user.roles))}.")


@app.command()
def reset(name: Name, data: Data, secret_file: SecretFile = None) -> None:
    """Give a user a new PIN or passphrase; the user is signed out everywhere and has no waiting time left."""
    user = UserTable(data / FOLDER).change(name, secret=_secret(secret_file))
    typer.echo(f"{user.name} has a new PIN or passphrase.")


@app.command("list")
@announced("reading the users")
def list_users(data: Data) -> None:
    """Name every user with the roles."""
    table = UserTable(data / FOLDER)
    for user in table.users():
        typer.echo(f"{user.name}: {', '.join(sorted(user.roles))}")
    if not table.has_begun:
        typer.echo("No user yet. `diffuscope label` prints the set-up code for the page")


def _secret(file: Path | None) -> str:
    if file is None:
        return str(typer.prompt("PIN or passphrase", hide_input=True, confirmation_prompt=True))
    return read_text(file).partition("\n")[0]
