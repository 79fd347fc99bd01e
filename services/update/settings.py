"""Where updates come from, and what must be so before one is installed: one TOML file, unknown keys refused."""

import tomllib
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from device.errors import SpecError
from services.records.update_notes import TABLET

PLACE = Path("/etc/diffuscope/update.toml")


class UpdateSettings(BaseModel):
    """What /etc/diffuscope/update.toml may say."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    channel: str = Field(default="", pattern="^(https://.+[^/])?$")  # folder of a web server; empty: sticks only
    authority: Path | None = None  # who vouches for that web server, if not the usual ones
    sticks: Path = Path("/media")  # where sticks appear, one folder each
    folder: Path = Path("/var/lib/diffuscope-update")
    wishes: Path = Path("/run/diffuscope-update")  # where the page leaves what a technician tapped
    keyring: Path = Path("/etc/rauc/keyring.pem")
    rauc: tuple[str, ...] = ("rauc",)
    restart: tuple[str, ...] = ("systemctl", "reboot")
    instrument: str = "http://127.0.0.1:8000"
    modules: Path = Path("/lib/modules")  # of the kernels that the running version came with
    lowest_battery: float = Field(default=0.5, ge=0, le=1)
    answer_s: float = Field(default=15.0, gt=0)  # within which the page must answer
    patience_s: float = Field(default=300.0, gt=0)  # within which a tried version must be well; it may have to compile

    @property
    def tablet(self) -> Path:
        """Where the page puts what a tablet sent."""
        return self.folder / TABLET


def load(path: Path) -> UpdateSettings:
    """The settings in a file; SpecError if it is not there or says what cannot be."""
    try:
        return UpdateSettings(**tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError, ValidationError) as error:
        raise SpecError(f"{path}: {error}", "Give the settings of this device with --settings.") from error
