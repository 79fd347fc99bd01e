"""Update settings: sources, preconditions, paths and timeouts in one TOML file; unknown keys are an error."""

from pathlib import Path

from pydantic import Field

from device.config.toml_file import Table, load_toml
from services.update.ipc import TABLET

SETTINGS_PATH = Path("/etc/diffuscope/update.toml")


class UpdateSettings(Table):
    """Content of /etc/diffuscope/update.toml; folders, URLs and commands have the defaults of the device."""

    channel: str = Field(default="", pattern="^(https://.+[^/])?$")  # URL of a folder; empty: USB drives only
    authority: Path | None = None  # CA file for the web server; None: system CAs
    sticks: Path = Path("/media")  # mount points of USB drives, one folder each
    folder: Path = Path("/var/lib/diffuscope-update")
    requests: Path = Path("/run/diffuscope-update")  # where the page writes requests
    keyring: Path = Path("/etc/rauc/keyring.pem")
    rauc: tuple[str, ...] = ("rauc",)
    restart: tuple[str, ...] = ("systemctl", "reboot")
    instrument: str = "http://127.0.0.1:8000"
    modules: Path = Path("/lib/modules")  # kernel modules of the running version
    bootloader: Path = Path("/proc/device-tree/chosen/bootloader/build-timestamp")  # of the Raspberry Pi's EEPROM
    lowest_battery: float = Field(default=0.5, ge=0, le=1)
    answer_s: float = Field(default=15.0, gt=0)  # timeout of requests to the instrument
    patience_s: float = Field(
        default=300.0, gt=0
    )  # timeout of the health checks of a tried version, including compilation

    @property
    def tablet(self) -> Path:
        """Folder of the update file that a tablet uploads through the page."""
        return self.folder / TABLET


def load_settings(path: Path) -> UpdateSettings:
    """Return the settings in a file; SpecError if it is missing or invalid."""
    return load_toml(path, UpdateSettings)
