"""Plug-ins: methods and effects of installed packages, methods of files, and the sentences about wrong ones."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile

from device import plugins
from device.config.head_file import InstrumentSpec, load_head
from device.errors import InputError, SettingError, SpecError
from device.recon.installed_methods import NEEDED, available_methods, find_method
from device.recon.method_settings import TAU
from device.recon.methods import METHODS, Method
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import Model
from device.recon.model.preprocessing import Linear
from device.recon.reconstructor import Reconstructor
from device.recon.solver_contract import check_method
from device.recon.solvers.solver import Solver
from device.recon.stage import Recipe
from device.sim.optical_setup import Scene
from device.sim.plan import decide
from device.sim.scene_files import simulate
from device.values import Calibration
from services.cli import main
from services.research.frontier import ROUNDS, Case, measure_frontier, selected_methods
from services.research.frontier_plot import draw_frontier
from tests import scenes
from tests.plugin_packages import GALLERY, OWN_EFFECT, OWN_SOLVER, installed
from tests.simulated import small_head_toml

SHAPE = (48, 64)
CALIBRATION = scenes.calibration(scenes.speckle(SHAPE))
COUNTS = np.random.default_rng(0).integers(500, 1500, SHAPE).astype(np.uint16)
BUBBLES = "[sim]\n[sim.effects.bubbles]\nspots = 30\n"


@pytest.fixture
def own_solver(tmp_path: Path) -> Iterator[None]:
    with installed(tmp_path, "own_solver", OWN_SOLVER, plugins.METHODS, fista="METHOD"):
        yield


@pytest.fixture
def own_effect(tmp_path: Path) -> Iterator[None]:
    with installed(tmp_path, "own_effect", OWN_EFFECT, plugins.EFFECTS, bubbles="EFFECT"):
        yield


# Methods


def solved(method: Method) -> np.ndarray:
    table = {method.name: method}
    make = Reconstructor(
        CALIBRATION, SHAPE, scenes.PLANNER, scenes.VirtualClock(), (Recipe(method.name, 1),), timed=False, methods=table
    )
    return make(COUNTS).picture


@pytest.mark.parametrize("name", METHODS)
def test_built_in_methods_fulfil_the_contract(name: str) -> None:
    check_method(METHODS[name])


@pytest.mark.usefixtures("own_solver")
def test_the_example_fulfils_the_contract() -> None:
    check_method(find_method("fista"))


def test_a_solver_that_lacks_a_part_of_the_interface_breaks_the_contract_by_its_name() -> None:
    method = replace(METHODS["tikhonov"], build=lambda *_: SimpleNamespace(start=print))
    with pytest.raises(AssertionError, match=r"tikhonov: its solver has all .* also .*step"):
        check_method(method)


@pytest.mark.usefixtures("own_solver")
def test_settings_without_configure_are_refused_with_the_name_of_the_plugin() -> None:
    method = replace(find_method("fista"), settings=(TAU,))
    recipe = Recipe("fista", 1, settings=(("tau", 1.0),))
    with pytest.raises(SettingError, match="no `configure`") as refused:
        Reconstructor(
            CALIBRATION, SHAPE, scenes.PLANNER, scenes.VirtualClock(), (recipe,), timed=False, methods={"fista": method}
        )
    assert "fista" in refused.value.message


@pytest.mark.usefixtures("own_solver")
def test_an_installed_method_is_listed_and_reconstructs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main_returns("methods", "--rows", 48, "--cols", 64)
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed[1:]] == [*METHODS, "fista"]
    tifffile.imwrite(tmp_path / "raw.tiff", COUNTS)
    tifffile.imwrite(tmp_path / "psf.tiff", scenes.speckle(SHAPE))
    words = ["reconstruct", tmp_path / "raw.tiff", "--psf", tmp_path / "psf.tiff", "-o", tmp_path / "x.npy"]
    main_returns(*words, "--report", tmp_path / "r.json", "--method", "fista")
    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["method"], report["rounds"], report["noise_dn"]) == ("fista", 100, None)
    assert report["regularisation"]["step_length"] > 0
    picture = np.load(tmp_path / "x.npy")
    main_returns(*words, "--method", f"{GALLERY / 'own_solver.py'}:METHOD")
    assert np.array_equal(np.load(tmp_path / "x.npy"), picture)


def main_returns(*words: object) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert ended.value.code == 0


@pytest.mark.usefixtures("own_solver")
def test_an_installed_method_has_points_in_the_frontier(tmp_path: Path) -> None:
    truth = np.random.default_rng(1).uniform(500, 1500, SHAPE).astype(np.float32)
    methods = {name: method for name, method in available_methods().items() if name in ("gradient", "fista")}
    case = Case("noise", COUNTS, truth, None, CALIBRATION, True)
    found = measure_frontier(case, tmp_path, 5.0, 1, lambda _: None, methods)
    assert {point.method for point in found.points} == {"gradient", "fista"}
    assert "fista (rounds)" in draw_frontier(found, methods)


@pytest.mark.usefixtures("own_solver")
def test_the_frontier_runs_the_rounds_that_it_names(tmp_path: Path) -> None:
    """FISTA counts its own rounds: the picture of the point "100 rounds" had 100, and that of 20 had 20."""
    truth = np.random.default_rng(1).uniform(500, 1500, SHAPE).astype(np.float32)
    fista, longest = find_method("fista"), [0]

    def counted(model: Model, calibration: Calibration, planner: Planner) -> Solver:
        return CountedRounds(fista.build(model, calibration, planner), longest)

    methods = {"fista": replace(fista, build=counted), "open": METHODS["open"]}
    found = measure_frontier(Case("noise", COUNTS, truth, None, CALIBRATION, True), tmp_path, 5.0, 1, print, methods)
    assert longest == [100]
    for method in methods.values():
        points = {point.rounds: point for point in found.points if (point.method, point.bin) == (method.name, 1)}
        assert set(points) == {*ROUNDS, method.rounds}
        assert points[method.rounds].psnr_db != points[20].psnr_db


class CountedRounds:
    """Solver that notes the largest number of rounds of a frame in `longest[0]`."""

    def __init__(self, solver: Solver, longest: list[int]) -> None:
        self._solver, self._longest, self._rounds = solver, longest, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._solver, name)

    def start(self, frame: Linear) -> None:
        self._rounds = 0
        self._solver.start(frame)

    def step(self) -> None:
        self._rounds += 1
        self._longest[0] = max(self._longest[0], self._rounds)
        self._solver.step()


def test_a_plug_in_that_fails_costs_its_own_points_only(tmp_path: Path) -> None:
    """It gives NaN after more than ten rounds: the points with fewer rounds, and all other methods, are measured."""
    late = "def finish(self, out): out[:] = np.nan if self.t > 6 else self.x"  # t grows by about half a round
    source = f"{OWN_SOLVER}\nclass Late(Fista):\n    {late}\nMETHOD = Method('late', 'x', Late, 0, 2, 60)\n"
    truth = np.random.default_rng(1).uniform(500, 1500, SHAPE).astype(np.float32)
    case = Case("noise", COUNTS, truth, None, CALIBRATION, True)
    with installed(tmp_path, "late", source, plugins.METHODS, late="METHOD"):
        found = measure_frontier(case, tmp_path, 5.0, 1, print, selected_methods(["gradient", "late"]))
    assert {p.rounds for p in found.points if p.method == "late"} == {0, 1, 2, 4, 8}
    assert {p.method for p in found.points} == {"gradient", "late"}
    assert [left_out.method for left_out in found.left_out if "bin 1," in str(left_out.method)] == [
        f"late, bin 1, {rounds} rounds" for rounds in (12, 20, 60)
    ]
    assert all("NaN" in left_out.reason for left_out in found.left_out)


@pytest.mark.usefixtures("own_solver")
def test_the_instrument_does_not_use_installed_methods() -> None:
    assert "fista" not in METHODS
    with pytest.raises(SettingError, match="no method 'fista'"):
        Reconstructor(CALIBRATION, SHAPE, scenes.PLANNER, scenes.VirtualClock(), (Recipe("fista", 1),))


def test_an_unknown_method_is_refused_with_all_names(own_solver: None) -> None:
    with pytest.raises(SettingError, match="no method 'fasta'") as error:
        find_method("fasta")
    assert error.value.remedy == f"Choose one of: {', '.join(METHODS)}, fista."
    with pytest.raises(SettingError, match="there is no file"):
        find_method("none.py:METHOD")
    with pytest.raises(SettingError, match="has no 'OTHER'"):
        find_method(f"{GALLERY / 'own_solver.py'}:OTHER")


def test_the_checked_parts_are_those_of_the_interface() -> None:
    assert set(NEEDED) == {name for name in vars(Solver) if not name.startswith("_")}


WRONG_METHODS = {
    "import no_such_module": "cannot be loaded: ModuleNotFoundError: No module named 'no_such_module'",
    "def f(:": "cannot be loaded: SyntaxError",
    "OTHER = 1": "cannot be loaded: AttributeError",
    "METHOD = 3": "is no device.recon.methods.Method but of type int",
    "METHOD = Method('other', 'x', Fista, rounds=1, round_pairs=1)": "is a Method of another name, 'other'",
    "METHOD = Method('own', 'x', Fista, rounds=8)": "has rounds = 8 with round_pairs = 0",
    "METHOD = Method('variation', 'x', Fista)": "has the name 'variation' of a built-in method",
}
WRONG_SOLVERS = {
    "def __init__(self, model): ...": "cannot be planned: TypeError",
    "finish = property()": "without `finish` of the interface Solver",
    "input_buffer = np.zeros((2, 2))": "has an input_buffer that is no float32 array of",
    "def start(self, frame): 1 / 0": "cannot start: ZeroDivisionError: division by zero",
    "def step(self): raise KeyError": "cannot run a round: KeyError",
    "def finish(self, out): out[:] = self.x[1:]": "ValueError: could not broadcast",
    "def finish(self, out): out[:] = np.nan": "samples that are NaN, infinite or not written",
    "def finish(self, out): return self.x": "samples that are NaN, infinite or not written",
    "def finish(self, out): out[:] = self.x; self.diagnostics = {}": "has diagnostics of type dict instead of",
}


@pytest.mark.parametrize("line", WRONG_METHODS)
def test_a_wrong_method_is_refused_in_one_sentence(line: str, tmp_path: Path) -> None:
    source = f"{OWN_SOLVER}\ndel METHOD\n{line}\n"
    with installed(tmp_path, "own", source, plugins.METHODS, own="METHOD"), pytest.raises(SettingError) as error:
        find_method("own")
    refuses(error.value, WRONG_METHODS[line], "the method 'own' of the package own 0.1", "METHOD")


@pytest.mark.parametrize("line", WRONG_SOLVERS)
def test_a_wrong_solver_is_refused_in_one_sentence(line: str, tmp_path: Path) -> None:
    source = f"{OWN_SOLVER}\nclass Wrong(Fista):\n    {line}\nMETHOD = Method('own', 'x', Wrong, 0, 2, 1)\n"
    with installed(tmp_path, "own", source, plugins.METHODS, own="METHOD"), pytest.raises(SettingError) as error:
        solved(find_method("own"))
    refuses(error.value, WRONG_SOLVERS[line], "the method 'own' of the package own 0.1", "METHOD")


def refuses(error: InputError, cause: str, label: str, target: str) -> None:
    assert cause in error.message
    assert error.message.startswith(label)
    assert "\n" not in error.message
    assert error.remedy == f"Repair own:{target} in own 0.1, or uninstall it."


@pytest.mark.parametrize("line", ["pass", "def configure(self, settings): self.weight = settings['weight']"])
def test_settings_reach_a_solver_that_takes_them(line: str, tmp_path: Path) -> None:
    setting = "from device.recon.method_settings import Setting\nWEIGHT = (Setting('weight', 'x', 0, 1),)"
    method = "METHOD = Method('own', 'x', Wrong, 0, 2, 1, settings=WEIGHT)"
    source = f"{OWN_SOLVER}\n{setting}\nclass Wrong(Fista):\n    {line}\n{method}\n"
    with installed(tmp_path, "own", source, plugins.METHODS, own="METHOD"):
        own = find_method("own")
    recipe = Recipe("own", 1, settings=(("weight", 0.5),))
    arguments = CALIBRATION, SHAPE, scenes.PLANNER, scenes.VirtualClock(), (recipe,)
    if line != "pass":
        assert Reconstructor(*arguments, timed=False, methods={"own": own})(COUNTS).report.method == "own"
        return
    with pytest.raises(SettingError) as error:
        Reconstructor(*arguments, timed=False, methods={"own": own})
    refuses(error.value, "has settings, but its solver has no `configure`", "the method 'own' of", "METHOD")


def test_two_packages_with_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with (
        installed(tmp_path, "own_b", OWN_SOLVER, plugins.METHODS, fista="METHOD"),
        installed(tmp_path / "a", "own_a", OWN_SOLVER, plugins.METHODS, fista="METHOD"),
        pytest.raises(SettingError, match=r"own-a 0.1 and own-b 0.1 both declare 'fista'"),
    ):
        find_method("fista")


def test_a_broken_plug_in_does_not_disturb_other_methods(tmp_path: Path) -> None:
    with installed(tmp_path, "own", "1 / 0", plugins.METHODS, own="METHOD"):
        assert find_method("variation") is METHODS["variation"]
        with pytest.raises(SettingError, match=r"'own' of the package own 0\.1 cannot be loaded: ZeroDivisionError"):
            available_methods()


# Effects


def scene_file(folder: Path, tables: str = BUBBLES) -> Path:
    path = folder / "scene.toml"
    path.write_text(small_head_toml("bubbly", tables, summed=4))
    return path


def explained(spec: InstrumentSpec) -> dict[str, float]:
    return {decision.name: decision.eta for decision in decide(Scene(spec, spec.light.colour))}


@pytest.mark.usefixtures("own_effect")
def test_an_installed_effect_is_decided_by_its_eta_and_simulated(tmp_path: Path) -> None:
    spec = load_head(scene_file(tmp_path))
    assert explained(spec)["bubbles"] > 0.05
    bubbly = simulate(spec, tmp_path / "bubbly")
    plan = json.loads((tmp_path / "bubbly" / "plan.json").read_text())
    assert plan["bubbles"]["simulated"] is True
    assert plan["bubbles"]["why"].startswith("30 discs cover")
    response = bubbly.setup(spec.light.colour).response
    assert response is not None
    assert response.min() == 0.5
    assert explained(load_head(scene_file(tmp_path, "[sim]\n[sim.effects.bubbles]\n")))["bubbles"] == 0
    assert "bubbles" not in explained(load_head(scene_file(tmp_path, "[sim]\n")))


def test_a_scene_that_names_a_missing_effect_is_refused(tmp_path: Path) -> None:
    path = scene_file(tmp_path)
    line = path.read_text().splitlines().index("[sim.effects.bubbles]") + 1
    with pytest.raises(SpecError) as error:
        load_head(path)
    assert error.value.message == (
        f"{path}, line {line}: sim.effects.bubbles: no installed package has the effect 'bubbles' (installed: none); "
        "install the package that declares it under diffuscope.effects, or remove this table"
    )


WRONG_SETTINGS = {
    "[sim.effects.bubbles]\nspots = 2000\n": "[sim.effects.bubbles]: spots: Input should be less than or equal to "
    "1000, not 2000; allowed: at least 0, at most 1000",
    "[sim.effects.bubbles]\nspot = 2\n": "[sim.effects.bubbles]: 'spot' is not a known key; did you mean 'spots'?",
    "[sim.effects]\nbubbles = 2\n": "an effect of a plug-in has a table [sim.effects.bubbles], not 2",
}


@pytest.mark.usefixtures("own_effect")
@pytest.mark.parametrize("tables", WRONG_SETTINGS)
def test_wrong_settings_of_an_effect_name_table_and_key(tables: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError) as error:
        explained(load_head(scene_file(tmp_path, f"[sim]\n{tables}")))
    assert WRONG_SETTINGS[tables] in error.value.message


WRONG_EFFECTS = {
    "1 / 0": "cannot be loaded: ZeroDivisionError",
    "EFFECT = Bubbles": "is the class Bubbles; declare an object of it",
    "EFFECT = 3": "is of type int, without `name` of the interface Effect",
    "Bubbles.name = 'sand'": "is an effect of another name, 'sand'",
    "Bubbles.size = lambda self, scene: 1.0": "gave the size 1.0; it is a Size",
    "Bubbles.size = lambda self, scene: Size(float('nan'), 'x')": "gave the size Size(eta=nan",
    "Bubbles.size = lambda self, scene: 1 / 0": "cannot give its size: ZeroDivisionError",
    "Bubbles.apply = lambda self, setup: 1 / 0": "cannot be applied: ZeroDivisionError",
    "Bubbles.apply = lambda self, setup: setup.multiply_response(np.ones((2, 2)))": "whose response is no finite array",
}


@pytest.mark.parametrize("line", WRONG_EFFECTS)
def test_a_wrong_effect_is_refused_in_one_sentence(line: str, tmp_path: Path) -> None:
    with (
        installed(tmp_path, "own", f"{OWN_EFFECT}\n{line}\n", plugins.EFFECTS, bubbles="EFFECT"),
        pytest.raises(SettingError) as error,
    ):
        simulate(load_head(scene_file(tmp_path)), tmp_path / "out")
    refuses(error.value, WRONG_EFFECTS[line], "the effect 'bubbles' of the package own 0.1", "EFFECT")
