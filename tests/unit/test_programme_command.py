"""Command `diffuscope programme check`."""

import json
from pathlib import Path

import pyrage
import pytest

from device.errors import SpecError
from services import cli
from services.records.programme import DEFAULT_PROGRAMME, load_programme


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


def with_table(folder: Path, table: str) -> Path:
    """Write the programme of the package with one more table, in place of one of the same name."""
    names = (table.splitlines()[0], "recipients = ")
    text = "\n".join(line for line in DEFAULT_PROGRAMME.read_text().splitlines() if not line.startswith(names))
    (folder / "programme.toml").write_text(f"{text}\n{table}\n")
    return folder / "programme.toml"


def test_retention_is_off_without_a_rule_and_printed_with_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file, printed in (
        (DEFAULT_PROGRAMME, "after the last visit: no rule"),
        (with_table(tmp_path, "[retention]\nraw_days = 90\nidentity_days = 90"), "last visit: raw 90, identity 90"),
    ):
        with pytest.raises(SystemExit):
            cli.main(["programme", "check", str(file)])
        assert printed in capsys.readouterr().out


@pytest.mark.parametrize(
    "rules",
    [
        "raw_days = 91\npictures_days = 90",
        "pictures_days = 91\nidentity_days = 90",
        "raw_days = 91\nidentity_days = 90",
        "raw_days = 0",
        "pictures_days = 1.5",
    ],
)
def test_a_retention_rule_out_of_order_or_range_is_refused(tmp_path: Path, rules: str) -> None:
    with pytest.raises(SpecError, match=r"programme.toml, line \d+: retention"):
        load_programme(with_table(tmp_path, f"[retention]\n{rules}"))


def test_a_public_key_is_printed_and_a_wrong_one_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    right = str(pyrage.x25519.Identity.generate().to_public())
    wrong = [f"{right[:-1]}{'q' if right[-1] != 'q' else 'p'}", str(pyrage.x25519.Identity.generate()), "age1", ""]
    for keys, status in ([right], 0), *(([right, key], 2) for key in wrong):
        file = with_table(tmp_path, f"[exports]\nrecipients = {json.dumps(keys)}")
        with pytest.raises(SystemExit) as ended:
            cli.main(["programme", "check", str(file)])
        printed = capsys.readouterr()
        assert ended.value.code == status
        assert (f"encrypted to {right}" in printed.out) == (status == 0)
        assert ("exports.recipients.1" in printed.err) == (status == 2)
        assert "AGE-SECRET-KEY" not in printed.err
