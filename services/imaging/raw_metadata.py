"""Metadata of a raw frame, stored as JSON in the tag ImageDescription of its TIFF: one writer and one reader."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import get_args

from device.config.marked_files import KEY, stated_by
from device.values import EYES, Colour, Eye, Illumination


@dataclass(frozen=True)
class RawMetadata:
    """Metadata of one raw frame; None for an entry that is unknown, and for `illumination` without light.

    `id`: identifier of the capture. `exposure_s`: exposure time in seconds. `head`: name of the head.
    """

    id: str | None = None
    eye: Eye | None = None
    taken_at: datetime | None = None
    exposure_s: float | None = None
    illumination: Illumination | None = None
    simulated: bool | None = None
    calibration_id: str | None = None
    head: str | None = None


def metadata_entries(metadata: RawMetadata) -> dict[str, object]:
    """Return the metadata as the entries of a JSON document."""
    return {
        "id": metadata.id,
        "eye": metadata.eye,
        "taken_at": None if metadata.taken_at is None else metadata.taken_at.isoformat(),
        "exposure_s": metadata.exposure_s,
        "illumination": None if metadata.illumination is None else asdict(metadata.illumination),
        KEY: metadata.simulated,
        "calibration_id": metadata.calibration_id,
        "head": metadata.head,
    }


def read_metadata(entries: Mapping[str, object]) -> RawMetadata:
    """Return the metadata with these JSON entries; None for one that is missing or of another type or range."""
    eye = entries.get("eye")
    return RawMetadata(
        id=_text(entries.get("id")),
        eye=next((name for name in EYES if name == eye), None),
        taken_at=_time(entries.get("taken_at")),
        exposure_s=_number(entries.get("exposure_s")),
        illumination=_illumination(entries.get("illumination")),
        simulated=stated_by(entries),
        calibration_id=_text(entries.get("calibration_id")),
        head=_text(entries.get("head")),
    )


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _number(value: object) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def _time(value: object) -> datetime | None:
    try:
        return datetime.fromisoformat(value) if isinstance(value, str) else None
    except ValueError:
        return None


def _illumination(value: object) -> Illumination | None:
    if not isinstance(value, Mapping):
        return None
    colours: tuple[Colour, ...] = get_args(Colour)
    colour = next((name for name in colours if name == value.get("colour")), None)
    level = _number(value.get("level"))
    return Illumination(colour, level) if colour is not None and level is not None and 0 < level <= 1 else None
