"""Command `diffuscope programme check`."""

from pathlib import Path

import pytest

from services import cli
from services.records.programme import DEFAULT_PROGRAMME


def test_a_valid_programme_is_summarised(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["programme", "check", str(DEFAULT_PROGRAMME)])
    assert ended.value.code == 0
    assert "R-centre (OD)" in (printed := capsys.readouterr().out)
    assert "vision below 6/18" in printed


def test_a_mistake_is_named_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = tmp_path / "programme.toml"
    wrong.write_text(DEFAULT_PROGRAMME.read_text().replace('"6/18"', '"6/7"'))
    with pytest.raises(SystemExit) as ended:
        cli.main(["programme", "check", str(wrong)])
    assert ended.value.code == 2
    assert f"{wrong}, line 9: referral.vision_limit" in capsys.readouterr().err
