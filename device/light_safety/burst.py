"""Burst: several frames in one illumination."""

from collections.abc import Callable, Sequence

from device.clock import Clock
from device.errors import LightCut
from device.light_safety.guard import GuardedLight
from device.ports import Camera
from device.values import EYES, ExposureSettings, Eye, Frame, Illumination

ROUNDING_S = 1e-6  # of sums of durations


def burst(
    camera: Camera,
    light: GuardedLight,
    illumination: Illumination,
    shot: ExposureSettings,
    count: int,
    clock: Clock,
    eyes: Sequence[Eye] = EYES,
    *,
    whole_s: float,
    in_visit: bool = False,
    parts: int = 1,
    taken: Callable[[Frame], None] = lambda _: None,
) -> tuple[Frame, ...]:
    """Return up to `count` frames in one illumination, which stays on from the first to the last of them.

    There are fewer if another frame, as long as the longest one so far, might not end before the guard turns the lamp
    off. With `parts` above 1 each of the `count` exposures of `whole_s` seconds is split into so many
    frames, and `shot` is one of them: the lamp is then on no longer than for `count` whole exposures, with one
    planned overhead for each of these; read-outs that take longer cost the last frames. The dose counts for `eyes`,
    whose limit is lower outside a visit. `taken` is called with each frame after its read-out, while the lamp is on: it
    must return at once. Raises LightCut if the guard has ended the first exposure; a frame that it ended later is left
    out. The lamp is dark at every exit.
    """
    frames: list[Frame] = []
    with light.on(illumination, eyes, in_visit=in_visit):
        begin_s = last_s = clock.now_s()
        longest_s = 0.0
        most_s = light.max_on_s
        while len(frames) < count * parts and (not frames or last_s + longest_s - begin_s < most_s):
            frame = camera.expose(shot)
            if frames and frame.illumination is None:
                break
            frames.append(require_lit(frame))
            taken(frame)
            longest_s = max(longest_s, clock.now_s() - last_s)
            last_s = clock.now_s()
            if parts > 1 and len(frames) == 1:
                most_s = min(most_s, count * _whole_s(shot.exposure_s, longest_s, parts, whole_s) + ROUNDING_S)
    return tuple(frames)


def _whole_s(part_s: float, longest_s: float, parts: int, whole_s: float) -> float:
    """Return how long the lamp may be on for one split exposure: `whole_s` with the overhead of one frame, seconds.

    `longest_s`: duration of the first part, of `part_s` of exposure. A longer overhead than the one by which the parts
    were made shorter does not count: a stall adds no light.
    """
    overhead_s = longest_s - part_s
    return whole_s + min(overhead_s, (whole_s - parts * part_s) / (parts - 1))


def require_lit(frame: Frame) -> Frame:
    """Return the frame unchanged if the lamp was on for its whole exposure; raise LightCut otherwise."""
    if frame.illumination is None:
        raise LightCut("the light went out during the exposure: it had been on for too long")
    return frame
