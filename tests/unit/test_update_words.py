"""What an operator reads about the last update, in each state that it can be in."""

import pytest

from services.update.journal import Entry, in_words


@pytest.mark.parametrize(
    ("entry", "under_way", "words"),
    [
        (Entry(), False, "Version 1.0 runs."),
        (Entry("fetching", share=0.42), True, "Version 1.0 runs. Another version: fetching, 42%."),
        (Entry("fetching", share=0.42), False, "Version 1.0 runs. Another version was interrupted: start anew."),
        (Entry("installing", "2.0", share=0.9), True, "Version 1.0 runs. Version 2.0: installing, 90%."),
        (Entry("installing", "2.0", share=0.9), False, "Version 1.0 runs. Version 2.0 was interrupted: start anew."),
        (
            Entry("installed", "2.0"),
            False,
            "Version 1.0 runs. Version 2.0 is installed and waits for `diffuscope update restart`.",
        ),
        (
            Entry("trying", "2.0"),
            False,
            "Version 1.0 runs. Version 2.0 did not finish starting, or lost power: 1.0 is back.",
        ),
        (Entry("committed", "1.0"), False, "Updated to 1.0. It was tried, found well, and stays."),
        (
            Entry("refused", said="The battery is low."),
            False,
            "Version 1.0 runs. The last update was not installed: The battery is low.",
        ),
        (
            Entry(offered="2.0"),
            False,
            "Version 1.0 runs. Version 2.0 is offered: `diffuscope update install`.",
        ),
    ],
)
def test_each_state_has_its_words(entry: Entry, under_way: bool, words: str) -> None:
    assert in_words(entry, "1.0", is_trying=False, under_way=under_way) == words


def test_a_try_says_what_comes_back() -> None:
    said = in_words(Entry("trying", "2.0", before="1.0"), "2.0", is_trying=True, under_way=False)
    assert said == "Version 2.0 is being tried; 1.0 is back if it does not do."
