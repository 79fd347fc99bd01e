"""Every wrong input of `wrong_inputs` gets one sentence and one remedy, through the command line."""

from pathlib import Path

import pytest

from tests.journey.wrong_inputs import TABLE, WRONG_INPUTS, WrongInput, call, row, write_right_inputs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    write_right_inputs(folder)
    return folder


def test_there_are_39_wrong_inputs() -> None:
    assert len({wrong.name for wrong in WRONG_INPUTS}) == 39


@pytest.mark.parametrize("wrong", WRONG_INPUTS, ids=lambda wrong: wrong.name)
def test_wrong_input_gets_one_sentence_and_one_remedy(folder: Path, wrong: WrongInput) -> None:
    words = wrong.words(folder)
    answer = call(words)
    lines = answer.err.strip().splitlines()
    assert wrong.answer in answer.err
    assert "Traceback" not in answer.err
    assert row(wrong, folder, words, answer) in TABLE.read_text(encoding="utf-8").splitlines()
    if wrong.noted:
        assert answer.code == 0
        assert len(lines) == 1, answer.err
        assert lines[0].startswith("note: ")
        assert lines[0].endswith(".")
    else:
        assert answer.code == 2
        assert answer.out == ""
        assert len(lines) == 2, answer.err
        assert lines[0].startswith("error: ")
        assert lines[1].endswith(".")
        assert not (folder / "picture.npy").exists() or "picture.npy" not in answer.out
