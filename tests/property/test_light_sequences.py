"""Light: no sequence of presses, aiming, kills or clock jumps exceeds a limit of dose or leaves the lamp on.

`make test-light` runs a thousand of them with the ledger in its database.
"""

from tests.property import light_sequences


def test_no_sequence_exceeds_the_dose_limit() -> None:
    tally = light_sequences.run(150, light_sequences.Eyes, 40)
    assert {"live picture", "refused", "killed while lit", "killed in the dark", "split press"} <= set(tally)


def test_no_sequence_exceeds_the_dose_limit_with_the_ledger_in_its_database() -> None:
    light_sequences.run(6, light_sequences.EyesWithDatabase, 15)


def test_each_further_frame_and_colour_of_a_press_adds_dose() -> None:
    doses = [light_sequences.doses_j_per_cm2(*mode) for mode in light_sequences.MODES]
    assert doses == sorted(doses)
    assert len(set(doses)) == len(doses)
