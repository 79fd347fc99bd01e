"""Catalogues of texts: i18next's JSON format, complete plurals, the placeholders of the master."""

import json
import re
from typing import get_args

import pytest

from services.records.answers import COMPLAINTS
from services.records.programme import REASONS, VISIONS
from services.records.visit import OutcomeCode
from tests.project_files import files, text

DRAFTS = ("hi", "ta", "te")
PLURAL = re.compile(r"(.+)_(zero|one|two|few|many|other)")
FORMS = {"one", "other"}  # of English, Hindi, Tamil and Telugu (CLDR)


def catalogue(name: str) -> dict[str, str]:
    """Return the texts of a catalogue by key; ValueError for a key that is there twice."""

    def unique(pairs: list[tuple[str, str]]) -> dict[str, str]:
        keys = [key for key, _ in pairs]
        if len(set(keys)) < len(keys):
            raise ValueError(f"{name}: {sorted(key for key in keys if keys.count(key) > 1)}")
        return dict(pairs)

    made: dict[str, str] = json.loads(text(f"web/i18n/{name}.json"), object_pairs_hook=unique)
    return made


def by_key(table: dict[str, str]) -> dict[str, dict[str, str]]:
    """Return the texts of each key by plural form; "" for a text without plurals."""
    grouped: dict[str, dict[str, str]] = {}
    for name, words in table.items():
        key, form = match.groups() if (match := PLURAL.fullmatch(name)) else (name, "")
        grouped.setdefault(key, {})[form] = words
    return grouped


def placeholders(words: str) -> set[str]:
    return set(re.findall(r"\{\{(\w+)\}\}", words))


ENGLISH, TECHNICIAN = catalogue("en"), catalogue("technician/en")


@pytest.mark.parametrize("name", ["en", "technician/en", "pairing/en", *DRAFTS])
def test_a_catalogue_is_flat_and_its_plurals_are_complete(name: str) -> None:
    table = catalogue(name)
    assert {key for key, words in table.items() if not isinstance(words, str) or not words.strip()} == set()
    assert {key for key, forms in by_key(table).items() if set(forms) not in ({""}, FORMS)} == set()
    assert {key for key, words in table.items() if re.search(r"[{}]", re.sub(r"\{\{\w+\}\}", "", words))} == set()


@pytest.mark.parametrize("folder", ["", "pairing/"])
@pytest.mark.parametrize("language", DRAFTS)
def test_a_translation_has_only_master_keys_and_variables(language: str, folder: str) -> None:
    master, draft = by_key(catalogue(f"{folder}en")), by_key(catalogue(folder + language))
    assert set(draft) <= set(master)
    for key, forms in draft.items():
        assert set(forms) == set(master[key]), key
        for form, words in forms.items():
            wanted = placeholders(master[key][form]) | placeholders(master[key].get("other", ""))
            assert placeholders(words) | {"count"} == wanted | {"count"}, f"{key}: {words}"
    missing = {key for key in master if key.startswith(("state.", "stop.", "do.", "aim.", "verdict."))} - set(draft)
    assert missing <= {"aim.live", "stop.other"}


@pytest.mark.parametrize("name", ["en", "technician/en", "pairing/en"])
def test_one_english_word_for_one_thing(name: str) -> None:
    """Patient, picture, saved, not possible, eye doctor, macula, optic disc: never another word for the same thing."""
    others = (
        r"\b(person|people|kept|keeping|specialist|photos?|shot|loupe|quick look|as taken|by itself|by themselves)\b"
        r"|^(could not|made|being made|agreed|erase|centre|nerve|to finish|dim room|daylight|hold still|complaints)$"
        r"|\b(being made|needs set-up|setting up|first ask|enough light|another screen|has no voice|read out)\b"
    )
    assert {key: words for key, words in catalogue(name).items() if re.search(others, words, re.IGNORECASE)} == {}


def test_the_pages_ask_for_texts_that_the_master_has() -> None:
    """Only keys that are written out; those that are made from a code are tried by the tests of the page."""
    shared, technician = set(by_key(ENGLISH)), set(by_key(TECHNICIAN))
    assert not shared & technician
    asked = 0
    for name in files():
        if re.fullmatch(r"web/(?!vendor/|i18n/).*\.js", name):
            keys = set(re.findall(r'\bt\("([^"]+)"', text(name)))
            asked += len(keys)
            assert keys <= shared | (technician if "technician/" in name else set()), name
    assert asked > 200


@pytest.mark.parametrize("language", ["en", *DRAFTS])
def test_every_outcome_has_its_texts_in_each_catalogue(language: str) -> None:
    headlines = {f"outcome.{code}" for code in get_args(OutcomeCode)}
    names = {f"complaint.{name}" for name in COMPLAINTS} | {f"reason.{name}" for name in REASONS}
    pictures = {"outcome.not_taken", "outcome.no_picture", "outcome.quality", "field.vision_od", "field.vision_os"}
    visions = {f"vision.{vision}" for vision in VISIONS if "/" not in vision}
    directions = {"outcome.today", "outcome.soon", "outcome.where", "outcome.phone"}
    assert headlines | names | pictures | visions | directions <= set(catalogue(language))
