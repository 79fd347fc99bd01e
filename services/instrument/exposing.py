"""What the head gives for a picture, and which part of a picture is the eye."""

from device.clock import Clock
from device.head import Head
from device.recon.model import field_box
from device.sequence import lit
from device.values import Eye, Frame, Glow, Image, Shot


def expose(head: Head, eyes: tuple[Eye, ...]) -> tuple[Frame, Frame]:
    """A lit frame and a dark one, if the head is well; the light counts for these eyes."""
    head.check()
    shot = Shot(head.spec.camera.exposure_s)
    before(head, eyes)
    head.camera.prepare(shot)
    try:
        with head.light.on(Glow(head.spec.light.colour), eyes):
            frame = lit(head.camera.expose(shot))
        return frame, head.camera.expose(shot)
    finally:
        head.light.off()


def expose_live(head: Head, eyes: tuple[Eye, ...], clock: Clock) -> tuple[Frame, float, float]:
    """A frame in the light for aiming, which counts for these eyes; when it was exposed, and when it was dark again."""
    shot = Shot(head.spec.camera.preview_exposure_s)
    before(head, eyes)
    head.camera.prepare(shot)
    try:
        with head.light.on(Glow(head.spec.light.preview_colour), eyes):
            exposed_s = clock.now_s()
            frame = lit(head.camera.expose(shot))
    finally:
        head.light.off()
    return frame, exposed_s, clock.now_s()


def before(head: Head, eyes: tuple[Eye, ...]) -> None:
    """Ask for the eye of the next light, while it is dark, where one is named."""
    if len(eyes) == 1:
        head.facing(eyes[0])


def eye_in(image: Image, head: Head) -> Image:
    """The part of a picture that people look at: the illuminated field."""
    whole = image.shape[:2] != head.camera.shape  # of a camera in another mode
    return image if whole else image[field_box(head.calibration, head.camera.shape)]
