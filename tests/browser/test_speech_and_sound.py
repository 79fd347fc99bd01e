"""Speech output in the patient's language, tones, vibrations, and the visual replacement without a voice."""

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.axe import axe_faults
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.real import Real
from tests.browser.walk import Open, after_debounce, agree, aiming, take_picture, tap, wait_for_preview

pytestmark = pytest.mark.browser

WEB = Path(__file__).parents[2] / "web"
VOICES = Path(__file__).with_name("voices.js")
SPOKEN = "window.spoken.filter(({ text }) => text)"
ENDED = "window.spoken.filter(({ ended }) => ended).map(({ ended }) => ended)"
# The tones are played; this only records frequencies and vibrations.
LISTEN = """
window.heard = [];
const play = OscillatorNode.prototype.start;
OscillatorNode.prototype.start = function (at) {
  window.heard.push(this.frequency.value);
  return play.call(this, at);
};
window.felt = [];
navigator.vibrate = (pattern) => window.felt.push(pattern);
"""
READY, TAKEN, GOOD, POOR = [880], [1320], [660, 990], [392, 262]


def sentences(language: str) -> dict[str, str]:
    """Return the sentences of a language from its file."""
    table: dict[str, str] = json.loads((WEB / f"i18n/{language}.json").read_text())
    return {key: words for key, words in table.items() if key.startswith("say.")}


def without_repeats(cues: list[Any]) -> list[Any]:
    """Return the cues without immediate repeats: where a scene changes, the eye may become ready more than once."""
    return [cue for cue, _ in itertools.groupby(cues)]


def expect_tones(page: Page, *tones: list[int]) -> None:
    """Wait for the notes of these tones and compare them with all notes that were played."""
    notes = [note for tone in tones for note in tone]
    for _ in range(100):
        played = without_repeats(page.evaluate("window.heard.map(Math.round)"))
        if len(played) >= len(notes):
            break
        page.wait_for_timeout(100)
    assert played == notes


@pytest.fixture
def voices_page(open_page: Open, real: Real) -> Page:
    """A page with four voices, on the consent question."""
    page = open_page("about:blank")
    page.context.add_init_script(path=VOICES)
    visit = real.begin_visit()
    page.goto(f"{real.url}/#/visit/{visit['id']}/patient")
    page.wait_for_selector("#say")
    return page


@pytest.mark.parametrize("language", ["hi", "ta", "te"])
def test_every_sentence_exists_in_every_language(language: str) -> None:
    assert set(sentences(language)) == set(sentences("en")) != set()


def test_consent_question_is_spoken_in_patient_language(voices_page: Page, real: Real) -> None:
    voices_page.locator("#say").tap()
    voices_page.get_by_role("button", name="தமிழ்").tap()
    expect(voices_page.locator("#say")).to_contain_text("Say: May we take pictures of your eyes?")
    expect(voices_page.locator("#say small")).to_have_text(sentences("ta")["say.consent"])
    expect(voices_page.locator("#say small")).to_have_attribute("lang", "ta")
    voices_page.locator("#say").tap()
    assert voices_page.evaluate(SPOKEN) == [
        {"text": sentences("en")["say.consent"], "lang": "en-GB"},
        {"text": sentences("ta")["say.consent"], "lang": "ta-IN"},
    ]
    assert voices_page.evaluate(ENDED) == [sentences("en")["say.consent"]], "a new sentence ends the old one"
    expect(voices_page.locator("html")).to_have_attribute("lang", "en")
    expect(voices_page.locator(".asking")).to_contain_text("These sentences are not checked yet")
    voices_page.reload()
    expect(voices_page.locator("#say small")).to_have_text(sentences("ta")["say.consent"])


def test_sentences_are_spoken_while_aiming(voices_page: Page) -> None:
    agree(voices_page)
    voices_page.locator("#say").tap()
    voices_page.locator("[data-slot=R-nerve]").tap()
    wait_for_preview(voices_page)
    voices_page.locator("#say").tap()
    voices_page.locator("#say-more").tap()
    voices_page.locator("dialog [data-value=hi]").tap()
    expect(voices_page.locator("dialog [data-say='say.still']")).to_contain_text(sentences("hi")["say.still"])
    voices_page.locator("dialog [data-say='say.still']").tap()
    expect(voices_page.locator("#sentence")).to_have_text(sentences("hi")["say.still"])
    assert [(utterance["text"], utterance["lang"]) for utterance in voices_page.evaluate(SPOKEN)] == [
        (sentences("en")["say.centre"], "en-GB"),
        (sentences("en")["say.nerve"], "en-GB"),
        (sentences("hi")["say.still"], "hi-IN"),
    ]
    assert look_for_faults(voices_page) + axe_faults(voices_page) == []
    voices_page.keyboard.press("Escape")
    expect(voices_page.locator("dialog[open]")).to_have_count(0)
    expect(voices_page.locator("#say small")).to_have_text(sentences("hi")["say.nerve"])


def test_remote_shutter_works_after_speech_button(voices_page: Page, real: Real) -> None:
    agree(voices_page)
    voices_page.locator("#say").tap()
    after_debounce(voices_page).keyboard.press("Enter")
    voices_page.wait_for_selector("[data-screen=picture]")
    assert (real.presses, len(voices_page.evaluate(SPOKEN))) == (1, 1)


@pytest.mark.parametrize("size", ["phone", "tablet"])
def test_without_voice_sentence_is_shown_large(open_page: Open, real: Real, size: str) -> None:
    page = aiming(open_page, real, SIZES[size])  # a headless Chromium has no voice
    expect(page.locator("#say")).to_contain_text("Read aloud: Look straight ahead.")
    page.locator("#say").tap()
    expect(page.locator("dialog[open] #sentence")).to_have_text("Look straight ahead.")
    expect(page.locator("#sentence")).to_have_css("font-size", "40.5px")
    expect(page.locator("dialog .warning")).to_have_text("This tablet cannot speak English.")
    assert look_for_faults(page) + axe_faults(page) == []
    page.locator("dialog[open] .primary").tap()
    expect(page.locator("#sentence")).to_be_hidden()


@pytest.mark.parametrize("voice", ["en-GB!", "en-GB?"])
def test_failed_or_stalled_voice_shows_large_text(open_page: Open, real: Real, voice: str) -> None:
    page = open_page("about:blank")
    page.context.add_init_script(path=VOICES)
    page.context.add_init_script(f"window.voices = ['{voice}']")
    visit = real.begin_visit()
    page.goto(f"{real.url}/#/visit/{visit['id']}/patient")
    page.locator("#say").tap()
    expect(page.locator("dialog[open] .warning")).to_have_text("The voice did not work. Please read aloud.")
    expect(page.locator("#sentence")).to_have_text(sentences("en")["say.consent"])


def test_tones_and_vibrations_of_capture_events(open_page: Open, real: Real) -> None:
    real.rig.world.faults.add("eye.closed")  # no hint "ready" and no tone for it
    page = open_page("about:blank")
    page.context.add_init_script(LISTEN)
    visit = real.begin_visit(consent="agreed")
    page.goto(f"{real.url}/#/visit/{visit['id']}/patient")
    tap(page, "#shoot")
    wait_for_preview(page)
    expect(page.locator(".prompt")).to_contain_text("No eye found")
    expect_tones(page)
    real.rig.world.faults.clear()
    page.wait_for_selector(".prompt[data-tone=ready]")
    expect_tones(page, READY)
    with real.poor_light("saturated"):
        take_picture(page)
        expect_tones(page, READY, TAKEN, POOR)
        tap(page, "#again")
        wait_for_preview(page)
        expect(page.locator(".prompt")).to_contain_text("Too bright.")
    page.wait_for_selector(".prompt[data-tone=ready]")
    take_picture(page)
    expect_tones(page, READY, TAKEN, POOR, READY, TAKEN, GOOD)
    assert without_repeats(page.evaluate("window.felt")) == [15, 30, [30, 60, 30], 15, 30, 15]


def test_no_tone_before_first_touch(open_page: Open, real: Real) -> None:
    page = open_page("about:blank")
    page.context.add_init_script(LISTEN)
    # Playwright's input counts as user activation, so the property is replaced.
    page.context.add_init_script("Object.defineProperty(navigator, 'userActivation', { value: {} })")
    visit = real.begin_visit(consent="agreed")
    page.goto(f"{real.url}/#/visit/{visit['id']}/aim/R-centre")
    page.wait_for_selector(".prompt[data-tone=ready]")
    page.wait_for_timeout(500)
    expect_tones(page)


def test_disabled_tones_stay_disabled(open_page: Open, real: Real) -> None:
    real.rig.world.faults.add("eye.closed")  # no hint "ready" and no tone for it
    page = open_page("about:blank")
    page.context.add_init_script(LISTEN)
    visit = real.begin_visit(consent="agreed")
    page.goto(f"{real.url}/#/visit/{visit['id']}/aim/R-centre")
    wait_for_preview(page)
    page.get_by_role("button", name="Menu").tap()
    page.locator("#sound").uncheck()
    page.locator("#sound").check()
    expect_tones(page, GOOD)  # the tone of the enabled setting
    page.locator("#sound").uncheck()
    page.get_by_role("button", name="Close").tap()
    take_picture(page)
    expect_tones(page, GOOD)
    page.reload()
    page.wait_for_selector(".stage[data-mark=final]")
    expect(page.locator("#sound")).not_to_be_checked()
    tap(page, "#again")
    take_picture(page)
    expect_tones(page)
