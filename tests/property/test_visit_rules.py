"""Numbers and outcomes: what holds for every number and every visit."""

from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from device.errors import InputError
from services.records.numbering import check_digit, is_checked, looks_automatic, numbered, tidy, whole
from services.records.protocol import VISIONS, load_protocol
from services.records.visit import Decided, SlotState, Taken, decided_after, outcome

PROTOCOL = load_protocol()
LIMIT = VISIONS.index(PROTOCOL.programme.vision_limit)
counters, prefixes = st.integers(1, 10**9), st.from_regex("[A-Z]{0,4}", fullmatch=True)


@given(prefixes, counters)
def test_an_automatic_number_is_checked_and_tidy(prefix: str, counter: int) -> None:
    number = numbered(prefix, counter)
    assert is_checked(prefix, number)
    assert tidy(f" {number.lower()} ") == number
    assert looks_automatic(prefix, number) == bool(prefix)


@given(st.from_regex("[A-Z]{1,4}", fullmatch=True), counters)
def test_a_number_with_its_check_digit_apart_is_the_same_number(prefix: str, counter: int) -> None:
    number = numbered(prefix, counter)
    assert tidy(f"{number[:-1]}-{number[-1]}".lower()) == number
    wrong = f"{number[:-1]}-{(int(number[-1]) + 1) % 10}"
    assert whole(wrong) == wrong


@given(counters, st.integers(0, 20), st.integers(1, 9))
def test_any_one_wrong_digit_is_found(counter: int, place: int, by: int) -> None:
    digits = numbered("", counter)
    place %= len(digits)
    wrong = digits[:place] + str((int(digits[place]) + by) % 10) + digits[place + 1 :]
    assert not is_checked("", wrong)


@given(counters, st.integers(0, 20))
def test_any_two_swapped_neighbours_are_found(counter: int, place: int) -> None:
    digits = numbered("", counter)
    place %= len(digits) - 1
    swapped = digits[:place] + digits[place + 1] + digits[place] + digits[place + 2 :]
    assume(swapped != digits)
    assert not is_checked("", swapped)


@given(counters, counters)
def test_two_people_never_have_one_number(one: int, other: int) -> None:
    assert (numbered("A", one) == numbered("A", other)) == (one == other)


@given(st.text(max_size=30))
def test_a_number_is_kept_as_it_can_be_spoken_or_refused(text: str) -> None:
    try:
        kept = tidy(text)
    except InputError:
        return
    assert kept == tidy(kept)
    assert kept.isascii()
    assert 1 <= len(kept) <= 20


def test_the_published_example_of_the_check_digit() -> None:
    assert check_digit("572") == "4"  # Damm 2004, as quoted everywhere


taken = st.builds(
    lambda name, word: Taken(name, None if word is None else {"word": word, "code": None, "numbers": {}}),
    st.from_regex("[a-z]{8}", fullmatch=True), st.sampled_from(["good", "again", None]),
)  # fmt: skip
slot_states = st.lists(taken, max_size=4, unique_by=lambda one: one.capture).flatmap(
    lambda shots: st.builds(
        SlotState, st.just(tuple(shots)),
        st.one_of(st.none(), st.just(Decided()), st.just(Decided(reason="pupil")),
                  *(st.just(Decided(one.capture)) for one in shots)),
    )
)  # fmt: skip
visits = st.fixed_dictionaries({slot.id: slot_states for slot in PROTOCOL.slots})
fields = st.fixed_dictionaries({}, optional={
    "complaints": st.none() | st.lists(st.sampled_from(["sudden_loss", "flashes", "pain", "red"]), unique=True),
    "vision_od": st.none() | st.sampled_from(VISIONS), "vision_os": st.none() | st.sampled_from(VISIONS),
})  # fmt: skip


@given(fields, visits)
def test_the_outcome_follows_the_rules_in_their_order(said: dict[str, Any], slots: dict[str, SlotState]) -> None:
    told = outcome(PROTOCOL, said, slots)
    urgent = {"sudden_loss", "pain"} & set(said.get("complaints") or [])
    weak = any(VISIONS.index(said[eye]) > LIMIT for eye in ("vision_od", "vision_os") if said.get(eye))
    states = {id: slot.state for id, slot in slots.items()}
    blank = any({states[f"{side}-centre"], states[f"{side}-nerve"]} == {"empty"} for side in "RL")
    expected = (
        "refer_today" if urgent else "refer_vision" if weak
        else "refer_picture" if blank or "could_not" in states.values() else "send"
    )  # fmt: skip
    assert told.code == expected
    assert told.sentence.endswith(".")
    assert not {"normal", "disease", "healthy", "retinopathy", "glaucoma"} & set(told.sentence.lower().split())


@given(slot_states)
def test_one_picture_stands_for_a_slot_and_it_is_one_of_its_own(slot: SlotState) -> None:
    chosen = slot.chosen
    assert chosen is None or chosen in slot.taken
    assert (slot.state == "taken") == (chosen is not None)
    if slot.decided is None and slot.taken:
        assert chosen is not None
        assert chosen.good == any(one.good for one in slot.taken)  # a good one, if there is any


@given(slot_states, taken)
def test_after_another_picture_a_slot_is_taken_and_never_worse(slot: SlotState, new: Taken) -> None:
    assume(new.capture not in {one.capture for one in slot.taken})
    after = SlotState((*slot.taken, new), decided_after(slot, new))
    assert after.state == "taken"
    assert after.chosen is not None
    assert after.chosen.good >= bool(slot.chosen and slot.chosen.good)
    assert after.taken[:-1] == slot.taken


@pytest.mark.parametrize("worse", [VISIONS[LIMIT], VISIONS[LIMIT + 1]])
def test_the_limit_itself_is_not_referred(worse: str) -> None:
    good = SlotState((Taken("a", None),))
    told = outcome(PROTOCOL, {"vision_os": worse}, {slot.id: good for slot in PROTOCOL.slots})
    assert told.code == ("send" if worse == VISIONS[LIMIT] else "refer_vision")
    if told.code == "refer_vision":
        assert told.sentence == "Refer: vision of the left eye below 6/18."


@pytest.mark.parametrize(
    ("right", "left", "sentence"),
    [
        (("taken", "could_not"), ("empty", "empty"),
         "Refer: not every picture of the right eye possible; picture of the left eye not taken."),
        (("could_not", "empty"), ("could_not", "could_not"), "Refer: picture of both eyes not possible."),
        (("taken", "taken"), ("could_not", "empty"), "Refer: picture of the left eye not possible."),
        (("taken", "empty"), ("taken", "taken"), "The pictures are kept, 1 not taken. They are for an eye specialist."),
        (("taken", "taken"), ("taken", "taken"), "The pictures are kept. They are for an eye specialist."),
    ],
)  # fmt: skip
def test_what_was_not_tried_was_not_impossible(right: tuple[str, str], left: tuple[str, str], sentence: str) -> None:
    refused = SlotState((), Decided(None, "pupil"))
    of = {"taken": SlotState((Taken("a", None),)), "empty": SlotState(), "could_not": refused}
    states = dict(zip(("R-centre", "R-nerve", "L-centre", "L-nerve"), (*right, *left), strict=True))
    assert outcome(PROTOCOL, {}, {slot: of[state] for slot, state in states.items()}).sentence == sentence
