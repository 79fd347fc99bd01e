"""Raw frames of a head without its lamp, as `diffuscope frame` takes them: one TIFF, the mean of several exposures."""

from pathlib import Path

import numpy as np

from device.atomic_io import write_atomically
from device.clock import Clock
from device.config.head_file import load_head
from device.errors import SettingError
from device.head import open_bench
from device.values import Counts, ExposureSettings
from services.imaging.picture_files import raw_tiff
from services.imaging.raw_metadata import RawMetadata


def take_frames(head: Path, output: Path, count: int, exposure_s: float | None, clock: Clock) -> Counts:
    """Write the rounded mean of `count` frames, lamp dark, to a raw TIFF with its metadata; return it, (rows, cols).

    `exposure_s` None: that of the head file. SettingError for another ending than .tif or .tiff, the errors of the
    head's parts, and StoreError if the file cannot be written. The TIFF is marked as simulated only if the frames are.
    """
    if output.suffix.lower() not in (".tif", ".tiff"):
        raise SettingError(f"{output} is no TIFF file by its name", "Give a name that ends in .tiff.")
    spec = load_head(head)
    shot = ExposureSettings(exposure_s or spec.camera.exposure_s)
    bench = open_bench(spec, clock)
    try:
        total = np.zeros(bench.camera.shape, np.float64)
        for _ in range(count):
            frame = bench.camera.expose(shot)
            total += frame.counts
    finally:
        bench.close()
    metadata = RawMetadata(taken_at=clock.wall(), exposure_s=shot.exposure_s, simulated=frame.simulated, head=spec.name)
    mean = np.rint(total / count).astype(np.uint16)
    write_atomically(output, raw_tiff(mean, metadata))
    return mean


def summary(counts: Counts) -> str:
    """Return shape and counts of a raw frame in words; a hot pixel does not hide how bright the frame is."""
    low, high = np.percentile(counts, (0.1, 99.9))
    span = f"counts {low:.0f} to {high:.0f}, but for 0.1 % of the pixels at either end; brightest {counts.max()}"
    return f"{counts.shape[0]} x {counts.shape[1]}, {span}"
