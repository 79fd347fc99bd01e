"""Light path: heads agree with `hardware/optics.toml`, or give the reason on the line of the deviation."""

import re
from pathlib import Path

import pytest

from device.config.head_file import InstrumentSpec, OpticsSpec, load_head
from device.config.toml_file import line_of
from device.errors import SpecError
from device.optics.light_path import LightPath, load_light_path, relay_of

HARDWARE = Path(__file__).parents[2] / "hardware"
OPTICS = HARDWARE / "optics.toml"
HEADS = sorted((HARDWARE / "heads").glob("*.toml"))
PATH = load_light_path(OPTICS)


def unexplained(path: LightPath, spec: InstrumentSpec, text: str) -> list[str]:
    """Return the keys in which a head deviates from the path without a reason on their line."""
    ours = spec.optics or path.optics
    chain = spec.light.chain or path.ring
    others = [("optics", key, getattr(ours, key), getattr(path.optics, key)) for key in OpticsSpec.model_fields]
    others += [
        ("light.chain", key, getattr(chain, key), getattr(path.ring, key))
        for key in ("rows", "cols", "pitch_mm", "ring_mm", "leds")
    ]
    lines = text.splitlines()
    found = []
    for table, key, here, there in others:
        line = line_of(text, [table, key])
        written = lines[line - 1] if line else ""
        if here != there and not re.search(rf"{key}\b.*# deviates: .{{10,}}", written):
            found.append(f"{table}.{key} = {here}, not {there}")
    return found


@pytest.mark.parametrize("head", HEADS, ids=lambda path: path.stem)
def test_heads_follow_the_light_path_or_give_a_reason(head: Path) -> None:
    assert unexplained(PATH, load_head(head), head.read_text()) == []


def test_deviation_without_a_reason_is_found(tmp_path: Path) -> None:
    text = (HARDWARE / "heads" / "imx296.toml").read_text()
    (other := tmp_path / "other.toml").write_text(text.replace("iris_um = 3200", "iris_um = 1600"))
    assert unexplained(PATH, load_head(other), other.read_text()) == ["optics.iris_um = 1600.0, not 3200.0"]
    other.write_text(text.replace("iris_um = 3200", "iris_um = 1600  # deviates: for pupils of 3 mm"))
    assert unexplained(PATH, load_head(other), other.read_text()) == []


def test_the_relay_of_the_path_is_the_heads_geometry() -> None:
    """`Geometry` and the drawing use the same relay."""
    relay = relay_of(PATH, PATH.optics)
    assert (relay.first_mm, relay.second_mm) == (PATH.relay.first_mm, pytest.approx(PATH.relay.second_mm))
    assert relay.angular_magnification == pytest.approx(PATH.optics.angular_magnification)


@pytest.mark.parametrize(
    ("was", "becomes", "says"),
    [
        ("second_mm = 50.0", "second_mm = 40.0", "the relay's lenses give 0.9375"),
        ("splitter_to_iris_mm = 25.0", "splitter_to_iris_mm = 50.0", "between the second lens and the iris"),
        ("focal_mm = 17.0", "focal_mm = 1.7", "focal_mm"),
        ("lens_mm = 50.8", "lens = 50.8", "did you mean 'lens_mm'"),
    ],
)
def test_invalid_light_path_is_refused(tmp_path: Path, was: str, becomes: str, says: str) -> None:
    (broken := tmp_path / "optics.toml").write_text(OPTICS.read_text().replace(was, becomes))
    with pytest.raises(SpecError, match=re.escape(says)):
        load_light_path(broken)
