"""Each hazard has a control, each control tests that its make target runs, in `.ci/run`."""

import re
import subprocess
from functools import cache

import pytest

from tests.hazards import Control, control_tests, hazards
from tests.project_files import ROOT, text

pytest_plugins = ["pytester"]
CONTROLS = [control for hazard in hazards() for control in hazard.controls]


@cache
def commands(target: str) -> str:
    """Return the commands of a make target, without those of the environment."""
    ready = [f"-o{file}" for file in (".venv/ready", ".venv/kernels", "browser", "buses", "strace")]
    done = subprocess.run(["make", "-n", *ready, target], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout


@pytest.mark.parametrize("control", CONTROLS, ids=lambda control: control.control)
def test_a_control_names_tests_that_its_make_target_runs(control: Control) -> None:
    words = set(commands(control.target).split())
    for test in control.tests:
        file, _, function = test.partition("::")
        assert f"\ndef {function}(" in text(file), f"{test} is not there"
        assert {file, file.rpartition("/")[0]} & words, f"make {control.target} does not run {file}"


def test_the_targets_of_controls_are_those_of_every_change() -> None:
    """A target outside of `.ci/run` would be run before a release only."""
    run = set(re.findall(r"step make ([\w-]+)", text(".ci/run")))
    assert {control.target for control in CONTROLS} <= run


def test_hazards_of_light_and_of_mix_ups_are_in_the_list() -> None:
    ids = [hazard.id for hazard in hazards()]
    assert len(set(ids)) == len(ids)
    assert {"retina-over-limit", "lamp-stays-on", "wrong-patient", "wrong-eye", "false-picture"} <= set(ids)


def test_a_test_of_a_control_fails_where_it_would_be_skipped(pytester: pytest.Pytester) -> None:
    (test, *_) = sorted(control_tests())
    file, _, function = test.partition("::")
    path = pytester.path / file
    path.parent.mkdir(parents=True)
    skipped = [f"@pytest.mark.skip\ndef {name}():\n    pass\n" for name in (function, "test_other")]
    path.write_text("\n\n".join(["import pytest\n", *skipped]))
    pytester.runpytest("-p", "tests.conftest", file).assert_outcomes(errors=1, skipped=1)
