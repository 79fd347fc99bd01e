"""Exam: random sequences of presses, faults and signals reach no undeclared state; every way out is dark.

`make test-exam` runs ten thousand of them.
"""

from tests.property import exam_sequences

COUNT = 200


def test_random_sequences_keep_every_rule() -> None:
    runner = exam_sequences.run(COUNT)
    assert runner.violations == []
    assert runner.count >= COUNT
    assert runner.done["stored"] > COUNT // 4, "the sequences must make captures"
    assert set(exam_sequences.ACTIONS) <= set(runner.done)


def test_a_failure_of_the_lamps_last_off_during_a_suspended_refinement_loses_no_second_capture() -> None:
    """The lamp fails after the second exposure and works again: the first press fails, the second one is stored."""

    def act(trigger: str, name: str, delay_s: float = 0.0, choice: int = 0) -> exam_sequences.Action:
        return exam_sequences.Action(trigger, delay_s, name, "OD", None, choice)

    lamp = exam_sequences.FAULTS.index(("light.silent",))
    script = [
        act("idle", "press"),
        act("time", "press", delay_s=0.6),
        act("verdict", "fault", choice=lamp),
        act("failed", "repair"),
    ]
    with exam_sequences.sequences() as runner:
        assert runner.play(script) == []
    assert (runner.done["accepted"], runner.done["stored"]) == (2, 1)
