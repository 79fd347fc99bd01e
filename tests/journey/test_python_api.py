"""The Python interface `diffuscope`: results of the command line, exact adjoint, marked simulations, errors."""

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import diffuscope
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from services import resources
from services.cli import main
from services.imaging.picture_files import to_png
from tests.scenes import speckle
from tests.simulated import small_head_toml


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> diffuscope.SimulatedScene:
    place = tmp_path_factory.mktemp("scene") / "small.toml"
    place.write_text(small_head_toml("Small simulated head"))
    return diffuscope.simulate(place)


def test_files_on_the_command_line_and_arrays_in_python_give_the_same(
    scene: diffuscope.SimulatedScene, tmp_path: Path
) -> None:
    scene.write(tmp_path)
    raw, psf, picture, report = (tmp_path / name for name in ("raw.tiff", "psf.tiff", "out.npy", "out.json"))
    with pytest.raises(SystemExit, match="0"):
        main(["reconstruct", str(raw), "--psf", str(psf), "-o", str(picture), "--report", str(report), "--rounds", "3"])
    made = diffuscope.reconstruct(scene.raw, scene.psf, rounds=3)
    np.testing.assert_array_equal(made.picture, np.load(picture))
    kept, present = json.loads(report.read_text()), json.loads(made.report_json())
    kept.pop("seconds"), present.pop("seconds")  # each run has its own
    assert kept == present


def test_a_picture_is_saved_for_eyes_and_linear(scene: diffuscope.SimulatedScene, tmp_path: Path) -> None:
    made = diffuscope.reconstruct(scene.raw, scene.psf, method="gradient")
    made.save(tmp_path / "picture.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "picture.npy"), made.picture)
    made.save(str(tmp_path / "picture.png"))
    assert (tmp_path / "picture.png").read_bytes() == to_png(made.picture, simulated=True)
    with pytest.raises(diffuscope.SettingError, match="is written as"):
        made.save(tmp_path / "picture.jpg")


def test_one_reconstructor_solves_many_frames(scene: diffuscope.SimulatedScene) -> None:
    again = diffuscope.Reconstructor(scene.psf, method="tikhonov", bin=2, settings={"mu": 1e-3})
    first, second = again(scene.raw), again(scene.raw)
    np.testing.assert_array_equal(first.picture, second.picture)
    assert first.report.regularisation["mu"] == 1e-3
    assert first.report.bin == 2


def test_pictures_of_simulated_counts_are_marked(scene: diffuscope.SimulatedScene) -> None:
    """Also after arithmetic; counts of another source are not."""
    darker = scene.raw // 2
    assert diffuscope.reconstruct(darker, scene.psf, method="tikhonov").simulated
    assert not diffuscope.reconstruct(np.array(darker), scene.psf, method="tikhonov").simulated


def test_a_scene_is_simulated_by_name_and_by_chosen_effects() -> None:
    plan = diffuscope.simulate("healthy", only=["shot"]).plan
    assert [decision.name for decision in plan.values() if decision.simulated] == ["shot"]


shapes = st.tuples(st.integers(20, 60), st.integers(20, 60))


@settings(max_examples=15, deadline=None)
@given(shape=shapes, bin=st.integers(1, 3), seed=st.integers(0, 1000), radius=st.none() | st.floats(4, 40))
def test_forward_and_adjoint_agree(shape: tuple[int, int], bin: int, seed: int, radius: float | None) -> None:
    """<forward(x), y> = <x, adjoint(y)>, to float32: 1e-4 of the norms, because the sums have thousands of terms."""
    model = diffuscope.ForwardModel(speckle(shape, seed), bin=bin, field_radius_px=radius)
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(model.object_shape).astype(np.float32)
    y = rng.standard_normal(model.frame_shape).astype(np.float32)
    left = float(np.vdot(model.forward(x).astype(np.float64), y))
    right = float(np.vdot(x.astype(np.float64), model.adjoint(y)))
    norms = float(np.linalg.norm(model.forward(x))) * float(np.linalg.norm(y))
    assert left == pytest.approx(right, abs=1e-4 * max(norms, 1e-6))


def test_the_noise_of_a_frame_is_measured() -> None:
    """Within 10 %: the median of about a thousand exponential values is known to 4 %."""
    model = diffuscope.ForwardModel(speckle((120, 160), grain_px=2.5))
    rng = np.random.default_rng(1)
    clean = model.forward(model.embed(np.full(model.frame_shape, 500, np.float32)))
    noisy = clean + rng.normal(0, 3, clean.shape).astype(np.float32)
    assert model.noise_dn(noisy) == pytest.approx(3, rel=0.1)


def test_frontier_of_a_recording_and_of_a_scene(tmp_path: Path) -> None:
    head = tmp_path / "tiny.toml"
    head.write_text(small_head_toml("Tiny simulated head", summed=4))
    scene = diffuscope.simulate(head)
    lines: list[str] = []
    found = diffuscope.frontier(scene=scene, repeats=1, progress=lines.append)
    assert found.simulated
    assert {point.method for point in found.points} == set(diffuscope.methods())
    assert lines
    recorded = diffuscope.frontier(scene.raw, scene.psf, scene.truth, repeats=1)
    assert recorded.frame == found.frame


def test_an_unknown_keyword_is_a_type_error_with_the_nearest_name(scene: diffuscope.SimulatedScene) -> None:
    misspelt: Any = {"mehtod": "gradient"}
    for call in (diffuscope.reconstruct, lambda _, psf, **given: diffuscope.Reconstructor(psf, **given)):
        with pytest.raises(TypeError, match="'mehtod' is no option of a reconstruction: did you mean 'method'"):
            call(scene.raw, scene.psf, **misspelt)
    with pytest.raises(diffuscope.SettingError, match="there is no split 'tset'"):
        diffuscope.open_dataset(".", split=cast(Any, "tset"))


def test_a_head_is_a_path_a_scene_or_a_name(scene: diffuscope.SimulatedScene, tmp_path: Path) -> None:
    path = tmp_path / "head.toml"
    path.write_text(small_head_toml("Small simulated head"))
    options: Any = {"method": "gradient", "refraction": False}
    pictures = [
        diffuscope.reconstruct(scene.raw, scene.psf, head=head, **options).picture for head in (path, str(path), scene)
    ]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])
    assert not np.array_equal(pictures[0], diffuscope.reconstruct(scene.raw, scene.psf, **options).picture)
    named = diffuscope.reconstruct(scene.raw, scene.psf, head="sim", **options)
    file = diffuscope.reconstruct(scene.raw, scene.psf, head=resources.HEADS / "sim.toml", **options)
    np.testing.assert_array_equal(named.picture, file.picture)
    with pytest.raises(diffuscope.SettingError, match="there is no head 'helthy'; did you mean 'healthy'"):
        diffuscope.reconstruct(scene.raw, scene.psf, head="helthy")


def test_a_closed_form_without_a_field_warns(scene: diffuscope.SimulatedScene) -> None:
    for method in ("tikhonov", "gradient", "evidence"):
        notes = diffuscope.reconstruct(scene.raw, scene.psf, method=method).report.warnings
        assert f"the closed form '{method}' takes the whole frame as lit" in notes[0]
    own = resources.ROOT / "services" / "research" / "site" / "gallery" / "own_solver.py"
    notes = diffuscope.reconstruct(scene.raw, scene.psf, method=f"{own}:METHOD").report.warnings
    assert "the plug-in 'fista' takes the whole frame as lit" in notes[0]
    assert not diffuscope.reconstruct(scene.raw, scene.psf, method="open").report.warnings
    with_field = diffuscope.reconstruct(scene.raw, scene.psf, head=scene, method="gradient", refraction=False)
    assert not with_field.report.warnings
    assert with_field.report.refraction_dpt is None


def test_counts_with_a_gamma_are_made_linear(scene: diffuscope.SimulatedScene) -> None:
    """The gamma is that of the file, black level included: the picture of the linear counts comes back."""
    top = float(scene.raw.max())
    encoded = np.rint(65535 * (np.asarray(scene.raw) / top) ** (1 / 2.2)).astype(np.uint16)
    linear = diffuscope.reconstruct(np.asarray(scene.raw), scene.psf, method="gradient")
    made = diffuscope.reconstruct(encoded, scene.psf, method="gradient", gamma=2.2)
    assert made.report.given["gamma"] == 2.2
    assert np.corrcoef(made.picture.ravel(), linear.picture.ravel())[0, 1] > 0.99
    with pytest.raises(diffuscope.SettingError, match="a gamma of 9"):
        diffuscope.reconstruct(encoded, scene.psf, gamma=9.0)


def test_a_residual_that_noise_does_not_explain_is_said(scene: diffuscope.SimulatedScene) -> None:
    """Light that the PSF does not explain, a bright square, is left over."""
    spoilt = scene.raw.copy()
    rows, cols = (size // 2 for size in spoilt.shape)
    spoilt[rows : rows + 40, cols : cols + 40] += 200
    made = diffuscope.reconstruct(spoilt, scene.psf, method="gradient")
    assert made.report.residual is not None
    assert made.report.residual > 3
    assert any(
        f"The residual is {made.report.residual:.1f} times the noise" in warning for warning in made.report.warnings
    )


def test_a_pair_of_a_data_set_is_reconstructed_and_stays_simulated(
    scene: diffuscope.SimulatedScene, tmp_path: Path
) -> None:
    scene.write(tmp_path / "one")
    (pair,) = diffuscope.open_dataset(tmp_path)
    assert isinstance(pair, diffuscope.Pair)
    made = diffuscope.reconstruct(pair.raw, pair.psfs, rounds=2)
    assert made.simulated
    files = diffuscope.reconstruct(tmp_path / "one" / "raw.tiff", tmp_path / "one" / "psf.tiff", rounds=2)
    assert made.picture == pytest.approx(files.picture, rel=1e-3, abs=1e-3 * float(files.picture.max()))


def wrong(scene: diffuscope.SimulatedScene) -> dict[str, Callable[[], object]]:
    model = diffuscope.ForwardModel(scene.psf, bin=3)
    return {
        "there is no scene": lambda: diffuscope.simulate("nowhere"),
        "pixels, the raw": lambda: diffuscope.reconstruct(scene.raw[:50], scene.psf),
        "cannot be read": lambda: diffuscope.reconstruct("nowhere.tiff", scene.psf),
        "needs a frame with its truth": lambda: diffuscope.frontier(scene.raw),
        "samples, and": lambda: model.forward(np.zeros((3, 3), np.float32)),
        "a bin of 0": lambda: diffuscope.ForwardModel(scene.psf, bin=0),
        "is empty": lambda: diffuscope.ForwardModel(scene.psf, field_radius_px=-1),
        "no colour filter pattern": lambda: diffuscope.reconstruct(scene.raw, scene.psf, bayer="xyz"),
        "no setting": lambda: diffuscope.reconstruct(scene.raw, scene.psf, method="open", settings={"my": 1}),
    }


def test_wrong_input_is_refused_with_a_remedy(scene: diffuscope.SimulatedScene) -> None:
    for words, call in wrong(scene).items():
        with pytest.raises(diffuscope.DiffuscopeError, match=words) as refused:
            call()
        assert refused.value.remedy.strip().endswith((".", "?"))


def test_raw_and_psf_are_read_from_files_of_a_name(scene: diffuscope.SimulatedScene, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "raw.tiff", np.asarray(scene.raw))
    made = diffuscope.reconstruct(str(tmp_path / "raw.tiff"), scene.psf, method="gradient")
    assert made.picture.shape == scene.raw.shape


PUBLIC = [getattr(diffuscope, name) for name in diffuscope.__all__ if name[0] != "_"]


@pytest.mark.parametrize("public", PUBLIC, ids=lambda public: public.__name__)
def test_public_docstrings_state_shapes_and_units(public: type | Callable[..., object]) -> None:
    """One plain sentence first; of what takes or returns images, the shape (rows, cols) and the unit of the values."""
    words = inspect.getdoc(public) or ""
    first = words.split("\n\n")[0]
    assert first[:1].isupper()
    assert first.rstrip().endswith(".")
    if public.__name__ in ("reconstruct", "ForwardModel", "SimulatedScene", "FileReconstruction", "frontier"):
        assert any(shape in words for shape in ("(rows, cols)", "rows x cols"))
    if public.__name__ in ("reconstruct", "ForwardModel", "FileReconstruction"):
        assert "DN" in words
    if public.__name__ in ("reconstruct", "simulate", "frontier", "Reconstructor", "ForwardModel", "methods"):
        assert "Error" in words
