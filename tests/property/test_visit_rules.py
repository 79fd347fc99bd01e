"""Identification numbers and visit outcomes: properties of every number and every visit."""

from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from device.errors import InputError
from services.records.capture import StoredVerdict
from services.records.json_values import FormValue
from services.records.numbering import (
    automatic_number,
    check_digit,
    has_valid_check_digit,
    join_check_digit,
    looks_automatic,
    normalise,
)
from services.records.programme import VISIONS, load_programme
from services.records.visit import Outcome, SlotCapture, SlotDecision, SlotState, decide_outcome, decision_after

PROGRAMME = load_programme()
LIMIT = VISIONS.index(PROGRAMME.referral.vision_limit)
counters, prefixes = st.integers(1, 10**9), st.from_regex("[A-Z]{0,4}", fullmatch=True)


@given(prefixes, counters)
def test_an_automatic_number_is_checked_and_tidy(prefix: str, counter: int) -> None:
    number = automatic_number(prefix, counter)
    assert has_valid_check_digit(prefix, number)
    assert normalise(f" {number.lower()} ") == number
    assert looks_automatic(prefix, number) == bool(prefix)


@given(st.from_regex("[A-Z]{1,4}", fullmatch=True), counters)
def test_a_separated_check_digit_gives_the_same_number(prefix: str, counter: int) -> None:
    number = automatic_number(prefix, counter)
    assert normalise(f"{number[:-1]}-{number[-1]}".lower()) == number
    wrong = f"{number[:-1]}-{(int(number[-1]) + 1) % 10}"
    assert join_check_digit(wrong) == wrong


@given(counters, st.integers(0, 20), st.integers(1, 9))
def test_one_wrong_digit_is_detected(counter: int, place: int, by: int) -> None:
    digits = automatic_number("", counter)
    place %= len(digits)
    wrong = digits[:place] + str((int(digits[place]) + by) % 10) + digits[place + 1 :]
    assert not has_valid_check_digit("", wrong)


@given(counters, st.integers(0, 20))
def test_two_swapped_neighbours_are_detected(counter: int, place: int) -> None:
    digits = automatic_number("", counter)
    place %= len(digits) - 1
    swapped = digits[:place] + digits[place + 1] + digits[place] + digits[place + 2 :]
    assume(swapped != digits)
    assert not has_valid_check_digit("", swapped)


@given(counters, counters)
def test_different_counters_give_different_numbers(left: int, right: int) -> None:
    assert (automatic_number("A", left) == automatic_number("A", right)) == (left == right)


@given(st.text(max_size=30))
def test_a_number_is_normalised_to_ascii_or_refused(text: str) -> None:
    try:
        tidied = normalise(text)
    except InputError:
        return
    assert tidied == normalise(tidied)
    assert tidied.isascii()
    assert 1 <= len(tidied) <= 20


def test_the_published_example_of_the_check_digit() -> None:
    assert check_digit("572") == "4"  # Damm 2004, as quoted everywhere


taken = st.builds(
    lambda name, word: SlotCapture(name, None if word is None else StoredVerdict(word)),
    st.from_regex("[a-z]{8}", fullmatch=True),
    st.sampled_from(["good", "again", None]),
)
slot_states = st.lists(taken, max_size=4, unique_by=lambda shot: shot.capture).flatmap(
    lambda shots: st.builds(
        SlotState,
        st.just(tuple(shots)),
        st.one_of(
            st.none(),
            st.just(SlotDecision()),
            st.just(SlotDecision(reason="pupil")),
            *(st.just(SlotDecision(shot.capture)) for shot in shots),
        ),
    )
)
visits = st.fixed_dictionaries({slot.id: slot_states for slot in PROGRAMME.slots})
fields = st.fixed_dictionaries(
    {},
    optional={
        "consent": st.sampled_from(["agreed", "declined"]),
        "complaints": st.none() | st.lists(st.sampled_from(["sudden_loss", "flashes", "pain", "red"]), unique=True),
        "vision_od": st.none() | st.sampled_from(VISIONS),
        "vision_os": st.none() | st.sampled_from(VISIONS),
    },
)


@given(fields, visits)
def test_the_headline_follows_the_rules_in_order(answers: dict[str, Any], slots: dict[str, SlotState]) -> None:
    result = decide_outcome(PROGRAMME, answers, slots)
    is_urgent = {"sudden_loss", "pain"} & set(answers.get("complaints") or [])
    is_low = any(VISIONS.index(answers[eye]) > LIMIT for eye in ("vision_od", "vision_os") if answers.get(eye))
    states = {id: slot.state for id, slot in slots.items()}
    whys = {slot.decision.reason for slot in slots.values() if slot.decision and slot.decision.reason}
    is_missing = any({states[f"{side}-centre"], states[f"{side}-nerve"]} == {"empty"} for side in "RL")
    is_refused = answers.get("consent") == "declined" or (whys == {"refused"} and "taken" not in states.values())
    expected = (
        "refer_today"
        if is_urgent
        else "refer_vision"
        if is_low
        else "declined"
        if answers.get("consent") == "declined"
        else "refer_picture"
        if is_missing or whys - {"refused"}
        else "declined"
        if is_refused
        else "send"
    )
    assert result.code == expected
    assert result.urgency == {"refer_today": "today", "declined": "none", "send": "none"}.get(expected, "soon")


@given(fields, visits)
def test_every_cause_is_a_reason_once(answers: dict[str, Any], slots: dict[str, SlotState]) -> None:
    reasons = decide_outcome(PROGRAMME, answers, slots).reasons
    assert len(set(reasons)) == len(reasons)
    of: dict[str, list[tuple[Any, Any, Any]]] = {}
    for reason in reasons:
        of.setdefault(reason.code, []).append((reason.eye, reason.field, reason.value))
    assert {value for _, _, value in of.get("complaint", [])} == set(answers.get("complaints") or [])
    eyes = (("OD", answers.get("vision_od")), ("OS", answers.get("vision_os")))
    low = [(eye, None, value) for eye, value in eyes if value and VISIONS.index(value) > LIMIT]
    assert of.get("vision", []) == low
    named = {(slot.eye, slot.field): slots[slot.id] for slot in PROGRAMME.slots}
    for (eye, field), slot in named.items():
        found = {reason.code for reason in reasons if reason.eye == eye and reason.field == field}
        if slot.state == "not_possible":
            assert found == {"not_possible"}
        elif slot.chosen:
            is_poor = slot.chosen.verdict is not None and not slot.chosen.is_good
            assert found == ({"quality"} if is_poor else set())
        elif answers.get("consent") == "declined":
            assert ("declined" in of, found) == (True, set())
        else:
            assert found == {"not_taken"} or (eye, None, None) in of["not_taken"]


@given(slot_states)
def test_the_chosen_picture_of_a_slot_is_one_of_its_own(slot: SlotState) -> None:
    chosen = slot.chosen
    assert chosen is None or chosen in slot.captures
    assert (slot.state == "taken") == (chosen is not None)
    if slot.decision is None and slot.captures:
        assert chosen is not None
        assert chosen.is_good == any(shot.is_good for shot in slot.captures)  # a good one, if there is any


@given(slot_states, taken)
def test_another_picture_never_makes_a_slot_worse(slot: SlotState, new: SlotCapture) -> None:
    assume(new.capture not in {shot.capture for shot in slot.captures})
    after = SlotState((*slot.captures, new), decision_after(slot, new))
    assert after.state == "taken"
    assert after.chosen is not None
    assert after.chosen.is_good >= bool(slot.chosen and slot.chosen.is_good)
    assert after.captures[:-1] == slot.captures


def outcome_of(states: tuple[str, ...], why: str = "pupil", **answers: FormValue) -> Outcome:
    """Return the outcome of a visit with these states of R-centre, R-nerve, L-centre and L-nerve."""
    of = {
        "taken": SlotState((SlotCapture("a", None),)),
        "empty": SlotState(),
        "no": SlotState((), SlotDecision(None, why)),
    }
    ids = ("R-centre", "R-nerve", "L-centre", "L-nerve")
    return decide_outcome(PROGRAMME, answers, {id: of[state] for id, state in zip(ids, states, strict=True)})


def listed(result: Outcome) -> list[str]:
    """Return the values of each reason as one text."""
    named = [(reason.code, reason.eye, reason.field, reason.value) for reason in result.reasons]
    return [" ".join(filter(None, values)) for values in named]


@pytest.mark.parametrize("vision", [VISIONS[LIMIT], VISIONS[LIMIT + 1]])
def test_vision_at_the_limit_is_not_referred(vision: str) -> None:
    result = outcome_of(("taken",) * 4, vision_os=vision)
    is_low = vision != VISIONS[LIMIT]
    assert (result.code, listed(result)) == (("refer_vision", ["vision OS 6/24"]) if is_low else ("send", []))


def test_the_outcome_lists_every_reason_the_most_urgent_first() -> None:
    result = outcome_of(("taken", "no", "empty", "empty"), vision_od="6/60", complaints=["red", "pain"])
    assert (result.code, result.urgency) == ("refer_today", "today")
    assert listed(result) == [
        "complaint pain",
        "complaint red",
        "vision OD 6/60",
        "not_possible OD nerve pupil",
        "not_taken OS",
    ]


@pytest.mark.parametrize(
    ("states", "code"),
    [
        (("no", "no", "no", "no"), "declined"),
        (("taken", "taken", "no", "no"), "send"),
        (("no", "no", "empty", "empty"), "refer_picture"),  # of the left eye no picture was tried
    ],
)
def test_pictures_that_the_patient_refused_are_no_referral(states: tuple[str, ...], code: str) -> None:
    result = outcome_of(states, why="refused")
    assert result.code == code
    assert "not_possible OS centre refused" in listed(result) or states[2] == "empty"
