"""Head files: an error names the file, the line, the key, and the closest known key."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from device.clock import VirtualClock
from device.config.head_file import ReplaySpec, load_head
from device.config.sensors import PRESETS
from device.config.toml_file import line_of
from device.errors import SpecError
from device.head import open_head
from device.light_safety.dose_ledger import MemoryLedger
from device.sim.replay import ReplayCamera, ReplayLight

HEADS = Path(__file__).parents[2] / "hardware" / "heads"
HEAD = HEADS / "sim.toml"
TEXT = HEAD.read_text()
Refused = Callable[[str], SpecError]


@pytest.fixture
def refused(tmp_path: Path) -> Refused:
    """Return a function that loads a head file with a text and returns its error."""

    def read(text: str) -> SpecError:
        path = tmp_path / "head.toml"
        path.write_text(text)
        with pytest.raises(SpecError) as error:
            load_head(path)
        assert str(path) in error.value.message
        assert error.value.remedy
        return error.value

    return read


def line(text: str, begin: str) -> int:
    return next(n for n, line in enumerate(text.splitlines(), 1) if line.startswith(begin))


@pytest.mark.parametrize(
    "path", sorted(HEAD.parent.glob("*.toml")) + sorted(HEAD.parents[2].glob("device/sim/scenes/*.toml"))
)
def test_every_shipped_head_and_scene_is_valid(path: Path) -> None:
    assert load_head(path).name


def test_simulated_head_has_the_papers_sensor(tmp_path: Path) -> None:
    spec = load_head(HEAD)
    assert (spec.camera.rows, spec.camera.cols, spec.camera.white_dn) == (1080, 1920, 4095)
    assert spec.camera.gain_e_per_dn == pytest.approx(23000 / (4095 - 64))
    with pytest.raises(ValidationError, match="frozen"):
        spec.camera.rows = 3  # type: ignore[misc]


TYPOS = {
    "rows": ("rowz", "camera.rowz"),
    "exposure_s": ("exposure_ms", "camera.exposure_ms"),
    "colour": ("color", "light.color"),
    "iris_um": ("iris_mm", "optics.iris_mm"),
    "seed": ("sead", "sim.sead"),
}


@pytest.mark.parametrize("right", TYPOS)
def test_a_typo_is_named_with_its_line_and_the_closest_key(refused: Refused, right: str) -> None:
    wrong, key = TYPOS[right]
    text = TEXT.replace(f"\n{right} =", f"\n{wrong} =")
    message = refused(text).message
    assert f"line {line(text, wrong)}:" in message
    assert f"'{key}' is not a known key; did you mean '{right}'?" in message


def test_a_typo_in_the_name_of_a_table_is_named_too(refused: Refused) -> None:
    text = TEXT.replace("[camera]", "[camra]")
    message = refused(text).message
    assert f"line {line(text, '[camra]')}:" in message
    assert "did you mean 'camera'?" in message


def test_unknown_key_without_a_similar_one_gets_no_suggestion(refused: Refused) -> None:
    message = refused(TEXT.replace("rows = 1080", "rows = 1080\nzzzzzz = 1")).message
    assert "'camera.zzzzzz' is not a known key" in message
    assert "mean" not in message


WRONG = {
    "rows = 1080": ("rows = 0", "camera.rows: Input should be greater"),
    "cols = 1920": ("cols = 1920.5", "camera.cols: Input should be a valid integer"),
    "pitch_um = 5.04": ("pitch_um = nan", "camera.pitch_um: Input should be a finite number"),
    "full_well_e = 23000": ("full_well_e = inf", "camera.full_well_e"),
    "iris_um = 3200": ("iris_um = -1", "optics.iris_um"),
    'colour = "green"': ('colour = "infrared"', "light.colour: Input should be 'red', 'green', 'blue' or 'amber'"),
    "max_on_s = 1.0": ("max_on_s = 3600", "light.max_on_s"),
    "seed = 1": ('seed = "one"', "sim.seed"),
}


@pytest.mark.parametrize("right", WRONG)
def test_invalid_value_is_named_with_its_line(refused: Refused, right: str) -> None:
    wrong, words = WRONG[right]
    assert f"\n{right}\n" in TEXT
    text = TEXT.replace(f"\n{right}\n", f"\n{wrong}\n")
    message = refused(text).message
    assert words in message
    assert f"line {line(text, wrong)}:" in message


def test_a_missing_key_is_named_with_the_line_of_its_table(refused: Refused) -> None:
    message = refused(TEXT.replace("rows = 1080\n", "")).message
    assert f"line {line(TEXT, '[camera]')}: camera.rows: Field required" in message


def test_an_item_of_a_list_is_named_with_the_line_of_the_list(refused: Refused) -> None:
    text = TEXT + '\n[replay]\nraws = [3]\npsfs = ["psf.npy"]\n'
    assert f"line {line(text, 'raws')}: replay.raws.0" in refused(text).message


def test_invalid_toml_and_missing_files_are_reported(refused: Refused, tmp_path: Path) -> None:
    message = refused(TEXT.replace("rows = 1080", "rows 1080")).message
    assert "is not TOML" in message
    assert f"line {line(TEXT, 'rows')}" in message
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(SpecError, match="cannot be read"):
            load_head(path)
    (tmp_path / "latin.toml").write_bytes(b'name = "\xfc"')
    with pytest.raises(SpecError, match="Latin-1"):
        load_head(tmp_path / "latin.toml")


def test_missing_tables_of_the_backend_are_refused(refused: Refused) -> None:
    assert "[optics] and [sim]" in refused(TEXT[: TEXT.index("[optics]")]).message
    replayed = TEXT.replace('"sim"', '"replay"')
    assert "[replay]" in refused(replayed).message


def test_an_exposure_that_the_guard_would_end_is_refused(refused: Refused) -> None:
    message = refused(TEXT.replace("max_on_s = 1.0", "max_on_s = 0.1")).message
    assert "camera.exposure_s = 0.1 is not shorter than light.max_on_s = 0.1" in message


def test_a_camera_cannot_see_the_lamp_of_another_backend(tmp_path: Path) -> None:
    mixed = TEXT.replace('[light]\nbackend = "sim"', '[light]\nbackend = "replay"')
    path = tmp_path / "mixed.toml"
    path.write_text(mixed + '\n[replay]\nraws = ["r.npy"]\npsfs = ["p.npy"]\n')
    with pytest.raises(SpecError, match="cannot see"):
        open_head(load_head(path), VirtualClock(), MemoryLedger(VirtualClock()))


def test_lines_are_found_through_comments_quotes_and_dots() -> None:
    text = '# camera.rows\n[ camera ]\n"rows" = 3\n[sim]\nrows = 4\n[a.b]\nc = 1\n'
    assert line_of(text, ["camera", "rows"]) == 3
    assert line_of(text, ["sim", "rows"]) == 5
    assert line_of(text, ["a", "b", "c"]) == 7
    assert line_of(text, ["camera", "missing"]) == 2
    assert line_of("camera.rows = 3\n", ["camera", "rows"]) == 1
    assert line_of(text, ["nowhere"]) is None


def test_sensor_profile_supplies_missing_keys(tmp_path: Path) -> None:
    text = HEAD.read_text()
    for key in ("rows", "cols", "pitch_um", "bit_depth", "black_dn", "full_well_e", "read_noise_e"):
        text = re.sub(rf"^{key} = .*\n", "", text, flags=re.MULTILINE)
    (tmp_path / "head.toml").write_text(text.replace("[camera]\n", '[camera]\nsensor = "imx296"\nread_noise_e = 9\n'))
    camera = load_head(tmp_path / "head.toml").camera
    assert (camera.rows, camera.cols, camera.pitch_um) == (1088, 1456, 3.45)
    assert camera.read_noise_e == 9
    (tmp_path / "head.toml").write_text(text.replace("[camera]\n", '[camera]\nsensor = "imx269"\n'))
    with pytest.raises(SpecError, match="did you mean 'imx296'"):
        load_head(tmp_path / "head.toml")


def test_a_sensor_preset_of_ones_own_is_read_beside_the_head_file(tmp_path: Path) -> None:
    text = HEAD.read_text()
    for key in ("rows", "cols", "pitch_um", "bit_depth", "black_dn", "full_well_e", "read_noise_e"):
        text = re.sub(rf"^{key} = .*\n", "", text, flags=re.MULTILINE)
    (tmp_path / "head.toml").write_text(text.replace("[camera]\n", '[camera]\nsensor = "my_sensor.toml"\n'))
    own = (PRESETS / "imx296.toml").read_text().replace("rows = 1088", "rows = 1000")
    (tmp_path / "my_sensor.toml").write_text(own)
    camera = load_head(tmp_path / "head.toml").camera
    assert (camera.sensor, camera.rows, camera.cols) == ("my_sensor", 1000, 1456)
    (tmp_path / "my_sensor.toml").write_text(own.replace("3.45", "345"))
    with pytest.raises(SpecError, match=r"line \d+: camera: .*my_sensor.toml, line 5: pitch_um: .*at most 100"):
        load_head(tmp_path / "head.toml")
    (tmp_path / "my_sensor.toml").unlink()
    with pytest.raises(SpecError, match=r"my_sensor.toml cannot be read"):
        load_head(tmp_path / "head.toml")


@pytest.mark.parametrize("backend", ["picamera2", "v4l2"])
def test_a_head_says_which_version_of_a_sensor_with_colour_filters_it_has(tmp_path: Path, backend: str) -> None:
    """A preset, or a sensor's own file, does not make a head of grey pixels accept a mosaic."""
    text = (HEADS / "imx477.toml").read_text(encoding="utf-8").replace('"picamera2"', f'"{backend}"')
    (file := tmp_path / "head.toml").write_text(text)
    assert load_head(file).camera.bayer is False
    silent = "\n".join(line for line in text.splitlines() if not line.startswith("bayer"))
    file.write_text(silent)
    with pytest.raises(SpecError, match=r"imx477 is usual with colour filters: write bayer = false"):
        load_head(file)
    (tmp_path / "own.toml").write_text((PRESETS / "imx477.toml").read_text(encoding="utf-8"))
    file.write_text(silent.replace('sensor = "imx477"', 'sensor = "own.toml"'))
    with pytest.raises(SpecError, match=r"own.toml is usual with colour filters"):
        load_head(file)


def test_a_head_with_colour_filters_takes_no_pictures_of_eyes(tmp_path: Path) -> None:
    """Refused before any part is opened, so before the first frame."""
    text = (HEADS / "imx477.toml").read_text(encoding="utf-8").replace("bayer = false", "bayer = true")
    (file := tmp_path / "head.toml").write_text(text)
    with pytest.raises(SpecError, match="colour filters") as caught:
        open_head(load_head(file), VirtualClock(), MemoryLedger(VirtualClock()))
    assert "--bayer" in caught.value.remedy


def test_a_recorded_mosaic_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grey = rng.poisson(1000, (64, 96)).astype(np.uint16)
    mosaic = grey.copy()
    mosaic[::2, ::2] //= 4
    mosaic[1::2, 1::2] //= 2
    for name, pixels in {"psf": grey, "grey": grey, "mosaic": mosaic}.items():
        np.save(tmp_path / f"{name}.npy", pixels)
    psfs = (tmp_path / "psf.npy",)
    ReplayCamera(ReplaySpec(raws=(tmp_path / "grey.npy",), psfs=psfs), ReplayLight(), VirtualClock()).close()
    with pytest.raises(SpecError, match=r"mosaic.npy is a mosaic of colour filters") as caught:
        ReplayCamera(ReplaySpec(raws=(tmp_path / "mosaic.npy",), psfs=psfs), ReplayLight(), VirtualClock())
    assert "--bayer" in caught.value.remedy
