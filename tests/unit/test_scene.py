"""Invalid scenes: refused with the key, the given value, and the permitted range."""

from pathlib import Path

import pytest

from device.config.head_file import load_head
from device.config.scene import SimSpec
from device.errors import SpecError
from tests.simulated import SCENES

TEXT = (SCENES / "healthy.toml").read_text()

BAD = {  # text added to a scene, and the required words of the error
    "a missing image": (
        '[sim.object]\nkind = "image"\nimage = "nowhere.png"',
        ("sim.object.image", "nowhere.png", "path of a photograph"),
    ),
    "no image": ('[sim.object]\nkind = "image"', ("sim.object", 'kind = "image"', "the path of a photograph")),
    "an image of a retina that is drawn": (
        f'[sim.object]\nimage = "{(SCENES / "healthy.toml").as_posix()}"',
        ("sim.object", 'kind = "image"', '"retina"'),
    ),
    "a cut ruler": (
        '[sim.object]\nkind = "ruler"\ncut_deg = [40, 30]',
        ("sim.object", "cut_deg", '"retina" or "image"', '"ruler"'),
    ),
    "an empty cut": ("[sim.object]\ncut_deg = [40, 0]", ("sim.object.cut_deg", "above 0", "below 120")),
    "a tiny pupil": ("[sim.eye]\npupil_um = 200", ("sim.eye.pupil_um", "200", "at least 1000", "at most 9000")),
    "a pupil beside the iris": (
        "[sim.eye]\npupil_um = 2000\ndecentred_um = 4000",
        ("sim.eye.decentred_um = 4000", "2000 um", "below 2200"),
    ),
    "a wide gaze": ("[sim.eye]\ngaze_deg = [40, 3]", ("sim.eye.gaze_deg", "(40.0, 3.0)", "allowed: 30")),
    "a steep retina": (
        "[sim.eye]\nretina_tilt_deg = [0, -31]",
        ("sim.eye.retina_tilt_deg", "31 deg", "allowed: 30"),
    ),
    "a far retina": (
        "[sim.eye]\nretina_decentred_um = [3000, 4000]",
        ("sim.eye.retina_decentred_um", "5000 um", "allowed: 3000"),
    ),
    "a strong oblique astigmatism": ("[sim.eye]\noblique_dpt = -1", ("sim.eye.oblique_dpt", "-1", "at least 0")),
    "an unknown light": ('[sim.eye]\nshown_by = "torch"', ("sim.eye.shown_by", "'torch'", "'human eye'")),
    "a wild pixel": ("[sim.sensor]\nprnu = 3", ("sim.sensor.prnu", "3", "at least 0", "at most 0.2")),
}
WRONG: dict[str, dict[str, tuple[str, ...]]] = {
    "field_deg = 33.4": {
        "field_deg = 120": ("optics.field_deg", "120", "above 0", "at most 90"),
        "wavelength_um = 10.6": ("optics.wavelength_um", "10.6", "above 0.3", "below 1.2"),
    },
    'sensor = "quantalux"': {
        'sensor = "quantalux"\nexposure_s = -0.1': ("camera.exposure_s", "-0.1", "above 0", "at most 10"),
        'sensor = "quantalux"\nread_noise_e = -1': ("camera.read_noise_e", "-1", "at least 0"),
    },
}


def message(text: str, folder: Path) -> str:
    path = folder / "scene.toml"
    path.write_text(text)
    with pytest.raises(SpecError) as error:
        load_head(path)
    assert error.value.remedy
    return error.value.message


@pytest.mark.parametrize("case", BAD)
def test_invalid_scene_is_refused_with_key_value_and_range(case: str, tmp_path: Path) -> None:
    added, words = BAD[case]
    found = message(f"{TEXT}\n{added}\n", tmp_path)
    assert all(word in found for word in words), found


@pytest.mark.parametrize(("right", "wrong"), [(right, wrong) for right, some in WRONG.items() for wrong in some])
def test_invalid_optics_and_camera_are_refused(right: str, wrong: str, tmp_path: Path) -> None:
    assert right in TEXT
    found = message(TEXT.replace(right, wrong), tmp_path)
    assert all(word in found for word in WRONG[right][wrong]), found


def test_scene_files_are_short_and_default_to_the_papers_optics(tmp_path: Path) -> None:
    optics = load_head(SCENES / "healthy.toml").optics
    assert optics is not None
    paper = (optics.iris_um, optics.diffuser_to_sensor_um, optics.angular_magnification, optics.field_deg)
    assert paper == (3200, 6000, 0.75, 33.4)
    assert max(len(path.read_text().splitlines()) for path in SCENES.glob("*.toml")) < 60


def test_scene_can_be_a_key() -> None:
    assert hash(SimSpec()) == hash(SimSpec())
    assert hash(SimSpec(seed=2)) != hash(SimSpec())
