"""Head and scene files by the names of the shipped ones: `healthy` stands for device/sim/scenes/healthy.toml."""

import difflib
from pathlib import Path

from device.errors import SettingError
from device.user_files import files_in
from services import resources


def scene_file(word: str | Path) -> Path:
    """Return the path of a scene: a file, or the name of a shipped one; SettingError for an unknown name."""
    return _named(word, "scene", [resources.SCENES])


def head_file(word: str | Path) -> Path:
    """Return the path of a head: a file, or the name of a shipped head or scene; SettingError for an unknown name."""
    return _named(word, "head", [resources.HEADS, resources.SCENES])


def _named(word: str | Path, kind: str, folders: list[Path]) -> Path:
    place = Path(word)
    if place.suffix == ".toml" or len(place.parts) > 1 or place.is_file():
        return place
    shipped = {path.stem: path for folder in folders for path in files_in(folder, "*.toml")}
    if str(word) not in shipped:
        near = difflib.get_close_matches(str(word), shipped, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        reason = f"there is no {kind} '{word}'{hint}" if place.parts else f"no {kind} is named"
        remedy = f"Give the path of a {kind} file, or one of: {', '.join(shipped)}."
        raise SettingError(reason, remedy)
    return shipped[str(word)]
