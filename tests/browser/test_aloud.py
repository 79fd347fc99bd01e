"""What can be heard: sentences in the person's own language, and tones; and what is seen where nothing can be."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.browser.axe import axe_faults
from tests.browser.looks import SIZES, look_for_faults
from tests.browser.stub import Stubbed
from tests.browser.walk import Open, aiming, live, settled, taken, tap

pytestmark = pytest.mark.browser

WEB = Path(__file__).parents[2] / "web"
VOICES = Path(__file__).with_name("voices.js")
SAID = "window.spoken.filter(({ text }) => text)"
ENDED = "window.spoken.filter(({ ended }) => ended).map(({ ended }) => ended)"
# The tones are real; this only writes down what is played, and what a tablet that vibrates would do.
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


def words(language: str) -> dict[str, str]:
    """The sentences of a language as its file has them."""
    text = (WEB / ("english.js" if language == "en" else f"words_{language}.js")).read_text()
    return dict(re.findall(r'^  "(say\.\w+)":\s+"([^"]+)"', text, re.M))


def heard(page: Page, *tones: list[int]) -> None:
    """Wait until as many notes were played as these tones have, and compare all that were."""
    notes = [note for tone in tones for note in tone]
    for _ in range(100):
        played = page.evaluate("window.heard.map(Math.round)")
        if len(played) >= len(notes):
            break
        page.wait_for_timeout(100)
    assert played == notes


@pytest.fixture
def talking(open_page: Open, stub: Stubbed) -> Page:
    """A tablet with four voices, where a person is asked."""
    page = open_page("about:blank")
    page.context.add_init_script(path=VOICES)
    visit = stub.stub.visits.begin()
    page.goto(f"{stub.url}/#/visit/{visit['id']}/person")
    page.wait_for_selector("#say")
    return page


@pytest.mark.parametrize("language", ["hi", "ta", "te"])
def test_every_sentence_is_there_in_every_language(language: str) -> None:
    assert set(words(language)) == set(words("en")) != set()


def test_the_question_is_asked_in_the_persons_language_and_the_screen_keeps_its_own(
    talking: Page, stub: Stubbed
) -> None:
    talking.locator("#say").tap()
    talking.get_by_role("button", name="தமிழ்").tap()
    expect(talking.locator("#say")).to_contain_text("Say: May we take pictures of the eyes?")
    expect(talking.locator("#say small")).to_have_text(words("ta")["say.consent"])
    expect(talking.locator("#say small")).to_have_attribute("lang", "ta")
    talking.locator("#say").tap()
    assert talking.evaluate(SAID) == [
        {"text": words("en")["say.consent"], "lang": "en-GB"},
        {"text": words("ta")["say.consent"], "lang": "ta-IN"},
    ]
    assert talking.evaluate(ENDED) == [words("en")["say.consent"]], "a new sentence ends the old one"
    expect(talking.locator("html")).to_have_attribute("lang", "en")
    expect(talking.locator(".asking")).to_contain_text("These sentences are drafts")
    talking.reload()
    expect(talking.locator("#say small")).to_have_text(words("ta")["say.consent"])


def test_while_aiming_one_tap_says_what_to_do_and_two_say_anything_else(talking: Page) -> None:
    tap(talking, "[data-value=agreed]")
    tap(talking, "#shoot")
    live(talking)
    talking.locator("#say").tap()
    talking.locator("[data-slot=R-nerve]").tap()
    live(talking)
    talking.locator("#say").tap()
    talking.locator("#say-more").tap()
    talking.locator("dialog [data-value=hi]").tap()
    expect(talking.locator("dialog [data-say='say.still']")).to_contain_text(words("hi")["say.still"])
    talking.locator("dialog [data-say='say.still']").tap()
    expect(talking.locator("#sentence")).to_have_text(words("hi")["say.still"])
    assert [(one["text"], one["lang"]) for one in talking.evaluate(SAID)] == [
        (words("en")["say.centre"], "en-GB"),
        (words("en")["say.nerve"], "en-GB"),
        (words("hi")["say.still"], "hi-IN"),
    ]
    assert look_for_faults(talking) + axe_faults(talking) == []
    talking.keyboard.press("Escape")
    expect(talking.locator("dialog[open]")).to_have_count(0)
    expect(talking.locator("#say small")).to_have_text(words("hi")["say.nerve"])


def test_a_remote_shutter_takes_a_picture_after_a_tap_on_the_voice(talking: Page, stub: Stubbed) -> None:
    tap(talking, "[data-value=agreed]")
    tap(talking, "#shoot")
    live(talking)
    talking.locator("#say").tap()
    settled(talking).keyboard.press("Enter")
    talking.wait_for_selector("[data-screen=picture]")
    assert (stub.stub.presses, len(talking.evaluate(SAID))) == (1, 1)


@pytest.mark.parametrize("size", ["phone", "tablet"])
def test_without_a_voice_the_sentence_is_shown_large_to_be_read_out(open_page: Open, stub: Stubbed, size: str) -> None:
    page = aiming(open_page, stub, SIZES[size])  # a headless Chromium has no voice at all
    expect(page.locator("#say")).to_contain_text("Read out: Look straight ahead.")
    page.locator("#say").tap()
    expect(page.locator("dialog[open] #sentence")).to_have_text("Look straight ahead.")
    expect(page.locator("#sentence")).to_have_css("font-size", "40.5px")
    expect(page.locator("dialog .warning")).to_have_text("This tablet has no voice for English.")
    assert look_for_faults(page) + axe_faults(page) == []
    page.locator("dialog[open] .primary").tap()
    expect(page.locator("#sentence")).to_be_hidden()


@pytest.mark.parametrize("voice", ["en-GB!", "en-GB?"])
def test_a_voice_that_fails_or_never_begins_is_replaced_by_large_words(
    open_page: Open, stub: Stubbed, voice: str
) -> None:
    page = open_page("about:blank")
    page.context.add_init_script(path=VOICES)
    page.context.add_init_script(f"window.voices = ['{voice}']")
    visit = stub.stub.visits.begin()
    page.goto(f"{stub.url}/#/visit/{visit['id']}/person")
    page.locator("#say").tap()
    expect(page.locator("dialog[open] .warning")).to_have_text("The voice did not work. Please read it out.")
    expect(page.locator("#sentence")).to_have_text(words("en")["say.consent"])


def test_ready_taken_good_and_poor_have_their_own_tones_and_are_felt(open_page: Open, stub: Stubbed) -> None:
    stub.stub.aim, stub.stub.verdicts = {"code": "closer", "fill": 0.4}, ["shot.moved"]
    page = open_page("about:blank")
    page.context.add_init_script(LISTEN)
    visit = stub.stub.visits.begin(consent="agreed")
    page.goto(f"{stub.url}/#/visit/{visit['id']}/person")
    tap(page, "#shoot")
    live(page)
    expect(page.locator(".prompt")).to_contain_text("a little closer")
    heard(page)
    stub.stub.aim = {"code": "ready", "fill": 0.9}
    page.wait_for_selector(".prompt[data-tone=ready]")
    heard(page, READY)
    stub.stub.aim = None  # the next aiming is without a word, and so without a tone
    taken(page)
    heard(page, READY, TAKEN, POOR)
    tap(page, "#again")
    taken(page)
    heard(page, READY, TAKEN, POOR, TAKEN, GOOD)
    assert page.evaluate("window.felt") == [15, 30, [30, 60, 30], 30, 15]


def test_no_tone_before_a_touch(open_page: Open, stub: Stubbed) -> None:
    page = open_page("about:blank")
    page.context.add_init_script(LISTEN)
    # The driver of the browser counts as a hand, so the browser's own answer is not there to be asked.
    page.context.add_init_script("Object.defineProperty(navigator, 'userActivation', { value: {} })")
    visit = stub.stub.visits.begin(consent="agreed")
    page.goto(f"{stub.url}/#/visit/{visit['id']}/aim/R-centre")
    page.wait_for_selector(".prompt[data-tone=ready]")
    page.wait_for_timeout(500)
    heard(page)


def test_tones_that_are_switched_off_stay_off(open_page: Open, stub: Stubbed) -> None:
    stub.stub.aim = None
    page = open_page("about:blank")
    page.context.add_init_script(LISTEN)
    visit = stub.stub.visits.begin(consent="agreed")
    page.goto(f"{stub.url}/#/visit/{visit['id']}/aim/R-centre")
    live(page)
    page.get_by_role("button", name="Menu").tap()
    page.locator("#sound").uncheck()
    page.locator("#sound").check()
    heard(page, GOOD)  # so that one knows what is switched on
    page.locator("#sound").uncheck()
    page.get_by_role("button", name="Close").tap()
    taken(page)
    heard(page, GOOD)
    page.reload()
    page.wait_for_selector(".stage[data-mark=final]")
    expect(page.locator("#sound")).not_to_be_checked()
    tap(page, "#again")
    taken(page)
    heard(page)
