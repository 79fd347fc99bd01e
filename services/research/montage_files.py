"""`diffuscope montage PICTURE ... -o OUT`: pictures of several gaze directions joined to one."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from device.config.head_file import load_head
from device.config.image_files import only_frame, read_image_file
from device.config.marked_files import KEY, is_marked_simulated, unstated_notes, without_band
from device.errors import FrameError, SpecError
from device.recon.montage import Montage, make_montage
from device.values import Image
from services.imaging.picture_files import from_srgb
from services.research.reconstruct_file import refuse_output, refuse_overwriting, write_or_raise, write_picture


def montage_files(
    pictures: Sequence[Path],
    output: Path,
    report: Path | None,
    progress: Callable[[str], None],
    head: Path | None = None,
) -> Montage:
    """Join picture files (.npy, .tiff or .png), write the montage and its report, and return it.

    The montage is marked as simulated if a picture is.
    `progress` gets a line for each picture that is placed. `head` is the head file of the instrument that took them:
    its scale in degrees places them on the sphere; None: on the plane. FrameError for a file that is no picture, or for
    pictures of different sizes; SettingError for an output that cannot be written or would replace a picture; SpecError
    for a wrong head file, or one without optics.
    """
    refuse_output(output)
    refuse_overwriting((output, report), pictures)
    px_per_deg = None if head is None else _scale_px_per_deg(head)
    joined = make_montage(
        [read_picture(path) for path in pictures],
        lambda done: progress(f"{done} of {len(pictures)} pictures placed"),
        px_per_deg,
    )
    for note in unstated_notes(pictures):
        progress(f"note: {note}")
    simulated = any(is_marked_simulated(path) for path in pictures)
    write_picture(output, joined.picture, simulated)
    if report is not None:
        entries = {
            "placed": [asdict(place) for place in joined.placed],
            "origin_px": joined.origin_px,
            "projection": joined.projection,
            "px_per_deg": joined.px_per_deg,
            KEY: simulated,
        }
        text = json.dumps(entries, indent=1)
        write_or_raise(report, lambda: report.write_text(text + "\n", encoding="utf-8"))
    return joined


def _scale_px_per_deg(head: Path) -> float:
    """Return the pixels per degree of a head's pictures; SpecError for a head file without optics."""
    scale = load_head(head).px_per_deg
    if scale is None:
        raise SpecError(f"{head} has no table [optics], so the scale of its pictures is not known")
    return scale


def read_picture(path: Path) -> Image:
    """Return a picture file as linear float32, (rows, cols) or (rows, cols, 3); an 8-bit PNG is decoded from sRGB.

    The band of a marked PNG is replaced by 0. FrameError for values that are not numbers, or for a black picture.
    """
    name = str(path)
    stored = only_frame(read_image_file(path).frames, name)
    is_coded = path.suffix.lower() == ".png" and stored.dtype == np.uint8
    pixels = from_srgb(stored.astype(np.uint8)) if is_coded else np.asarray(stored, np.float32)
    if is_coded and is_marked_simulated(path):
        pixels = without_band(pixels)
    if not np.isfinite(pixels).all():
        raise FrameError(f"{name} holds values that are not numbers", "Reconstruct the picture again.")
    if not pixels.max() > 0:
        raise FrameError(f"{name} is black", "Leave it out.")
    return pixels


def placed_lines(joined: Montage, pictures: Sequence[Path]) -> list[str]:
    """Return a line for each picture: its place, or why it has none."""
    lines = []
    for path, place in zip(pictures, joined.placed, strict=True):
        if place.shift_px is None or place.rotation_deg is None:
            lines.append(f"{path}: not used: {place.reason}")
        elif place.peak is None:
            lines.append(f"{path}: the reference")
        else:
            down, right = place.shift_px
            lines.append(
                f"{path}: {down:+.1f} px down, {right:+.1f} px right, rotation {place.rotation_deg:+.2f} deg, "
                f"correlation {place.peak:.2f}, overlap {place.overlap:.0%}"
            )
    return lines
