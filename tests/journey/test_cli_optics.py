"""`diffuscope optics`: agreement of its output with OPTICS.md, and its refusals."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from services import resources
from services.cli import main
from tests.progress_lines import without_progress
from tests.project_files import ROOT

HEADS = ROOT / "hardware" / "heads"


def printed(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["optics", *(str(word) for word in words)])
    output = capsys.readouterr()
    assert ended.value.code == 0, output.err
    assert without_progress(output.err) == ""
    return output.out


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["optics", *(str(word) for word in words)])
    output = capsys.readouterr()
    assert ended.value.code == 2
    assert "Traceback" not in output.err
    return " ".join(output.err.replace("│", " ").split())


def row(table: str, name: str) -> str:
    """Return the line of a quantity, with runs of spaces reduced to one."""
    return " ".join(next(line for line in table.splitlines() if line.startswith(name)).split())


def test_without_options_the_design_tables_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """The tables are those of OPTICS.md 1.2 and 1.5, to the digit except where the sensors' sides are rounded there."""
    report = " ".join(printed(capsys).split())
    for line in (
        "33.4 15.001 1.3116 5.823 1155 5.900",
        "45.0 20.711 1.7671 6.734 1336 6.928",
        "48.3 22.418 1.8967 6.993 1388 7.235",
        "50.0 23.315 1.9635 7.127 1414 7.397",
        "51.2 23.956 2.0106 7.221 1433 7.512",
        "quantalux 9.68 x 5.44 15.6 19.0 82.5 / 28.6 102.8 / 48.9 154.3 / 73.4 0.98",
        "imx296 5.02 x 3.75 22.8 13.0 23.2 / 7.0 43.6 / 27.4 65.4 / 41.1 0.72",
        "imx477 6.29 x 4.71 50.7 5.9 39.3 / 19.3 59.7 / 39.6 89.5 / 59.4 0.88",
        "ov9281 3.84 x 2.40 26.2 11.3 8.1 / 0.0 28.5 / 10.2 42.8 / 15.3 0.46",
    ):
        assert line in report


def test_budget_of_a_head_reports_fit_and_misfit(capsys: pytest.CaptureFixture[str]) -> None:
    report = printed(capsys, "--head", HEADS / "imx296.toml")
    assert row(report, "d + 2s").startswith("d + 2s 5.823 mm")
    assert "3.75 mm smaller than d + 2s: the frame is cropped" in row(report, "short side")
    assert row(report, "scale on the retina").endswith("13.0 um/px eye of 17 mm")
    assert "8 LEDs, inside this pupil; clears the cornea's reflex, 4.48 mm" in row(report, "ring at the pupil")
    assert "never simulated" in row(report, "expected half-period")
    paper = printed(capsys, "--head", HEADS / "paper.toml")
    assert "9.68 mm holds d + 2s" in row(paper, "long side")
    assert "12 LEDs" in row(paper, "ring at the pupil")


def test_eye_determines_scale_and_margin(capsys: pytest.CaptureFixture[str]) -> None:
    report = printed(capsys, "--sensor", "quantalux", "--eye-mm", 25, "--pupil-mm", 3)
    assert "28.0 um/px eye of 25 mm" in row(report, "scale on the retina")
    assert "0.40 mm the iris stays filled within 25.3 deg" in row(report, "pupil margin")
    assert "OUTSIDE this pupil" in row(report, "ring at the pupil")
    assert "never fills" in row(printed(capsys, "--sensor", "quantalux", "--pupil-mm", 2), "pupil margin")


def test_too_small_sensor_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    """The short side receives less than half of the light of the edge (OPTICS.md 1.5)."""
    edges = [line for line in printed(capsys, "--sensor", "ov9281").splitlines() if "edge of the field" in line]
    assert ["too little" in line for line in edges] == [False, True]


def test_drawing_is_written_with_the_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "path.svg"
    report = printed(capsys, "--sensor", "imx477", "--svg", out)
    assert str(out) in report
    assert ElementTree.parse(out).getroot().get("role") == "img"
    assert "cannot be written" in refused(capsys, "--sensor", "imx477", "--svg", tmp_path / "none" / "path.svg")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--sensor", "imx29"], "no sensor is called 'imx29'"),
        (["--sensor", "imx296", "--head", HEADS / "sim.toml"], "not both"),
        (["--svg", "x.svg"], "choose --head or --sensor"),
        (["--eye-mm", "25"], "choose --head or --sensor"),
        (["--sensor", "imx296", "--eye-mm", "nan"], "eye"),
        (["--sensor", "imx296", "--pupil-mm", "0"], "pupil"),
        (["--head", HEADS / "none.toml"], "cannot be read"),
    ],
)
def test_contradictory_options_are_refused(capsys: pytest.CaptureFixture[str], words: list[object], says: str) -> None:
    assert says in refused(capsys, *words)


def test_recording_without_optics_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (head := tmp_path / "replay.toml").write_text(
        'name = "Replay"\n[camera]\nbackend = "replay"\nrows = 8\ncols = 8\npitch_um = 5\nfull_well_e = 1000\n'
        'read_noise_e = 1\n[light]\nbackend = "replay"\n[replay]\nraws = ["a.npy"]\npsfs = ["b.npy"]\n'
    )
    assert "no table [optics]" in refused(capsys, "--head", head)


def test_light_path_file_exists() -> None:
    assert resources.LIGHT_PATH == ROOT / "hardware" / "optics.toml"
