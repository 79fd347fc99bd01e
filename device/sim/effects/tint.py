"""Reflectance by colour: the object as this colour of light sees it (optics.md 3.7)."""

from device.sim.setup import Scene, Setup, Size

name = "tint"

ETA = {"red": 10.0, "green": 0.0, "blue": 5.0}  # vessels have a seventh, and four fifths, of their green contrast


def size(scene: Scene) -> Size:
    """Nothing in green, the colour in which an object is drawn; nothing where the object has no colour."""
    if scene.sim.object.kind not in ("retina", "image"):
        return Size(0.0, "this object looks the same in every colour")
    return Size(ETA[scene.colour] * scene.weight, f"seen in {scene.colour}; vessels are drawn for green")


def apply(setup: Setup) -> None:
    """The object's own reflectance in this colour."""
    setup.object = setup.subject.reflectance[setup.scene.colour]
