"""Preparation of the frames of a press while the next ones are exposed: verdict, quick look, and the joined burst."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType

from device.errors import FrameError
from device.recon.burst import JoinedFrame
from device.recon.burst_reconstructor import BurstReconstructor, PreparedFrame
from device.values import Colour, Counts, Frame, Image, Verdict
from services.instrument.frame_feedback import FrameAssessor

FRAME_QUALITY = "frame quality"  # begins the reason of a frame that its own verdict keeps out of the picture
Looked = Callable[[Image, bool], None]  # with the quick look of the first useful frame, and whether it is simulated


@dataclass(frozen=True)
class AssessedFrame:
    """Verdict on a lit frame, and what is prepared of it; `prepared` is None for a useless frame."""

    verdict: Verdict
    prepared: PreparedFrame | None


@dataclass(frozen=True)
class JoinedBurst:
    """The joined frames of a press; `order`: their numbers, the first good one in front (`ranked`)."""

    order: tuple[int, ...]
    frame: JoinedFrame


def ranked(verdicts: Sequence[Verdict]) -> tuple[list[int], dict[int, str]]:
    """Return the order of the frames of a press, and the reason of each that must not enter the picture.

    The first good frame comes first; without one the order stays. A frame with another verdict than the first one is
    unusable. Reasons are by the place in the order.
    """
    best = next((k for k, verdict in enumerate(verdicts) if verdict.word == "good"), 0)
    order = [best, *(k for k in range(len(verdicts)) if k != best)]
    unusable = {
        place: f"{FRAME_QUALITY}: {verdicts[k].code}"
        for place, k in enumerate(order)
        if verdicts[k].code != verdicts[best].code
    }
    return order, unusable


class FramePreparation:
    """Preparation of the frames of one press in a thread of its own; a context, at whose exit the thread has ended.

    The thread of the press calls the methods. Until the exit it must not use `assessor`, `bursts` and what `looked`
    uses: the thread of the preparation does. Only frames in the light of the burst, `colour`, are prepared. `begin_s`:
    begin of the press (clock seconds). `looked` is called once, with the quick look of the first useful frame, whose
    refraction is estimated with `refract`, its cylinder with `cylinder`. `alone`: the press takes one lit frame.

    A prepared frame holds 5 bytes per pixel: 8 frames of 2 MP, the most of a press, take 83 MB.
    """

    def __init__(
        self,
        assessor: FrameAssessor,
        bursts: BurstReconstructor,
        colour: Colour,
        begin_s: float,
        looked: Looked,
        *,
        refract: bool = True,
        cylinder: bool = True,
        alone: bool = False,
    ) -> None:
        self._assessor = assessor
        self._bursts = bursts
        self._colour = colour
        self._begin_s = begin_s
        self._looked: Looked | None = looked
        self._refract = refract
        self._options = {"cylinder": cylinder, "alone": alone}
        self._executor = ThreadPoolExecutor(1, "preparation")
        self._dark: Counts | None = None
        self._ready: dict[int, Future[AssessedFrame]] = {}
        self._counts: dict[int, Counts] = {}
        self._joined: Future[JoinedBurst | None] | None = None

    def __enter__(self) -> "FramePreparation":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown(cancel_futures=True)

    def add(self, frame: Frame) -> None:
        """Begin to prepare a frame after its read-out; return at once. The dark frame of the press is the first one."""
        if frame.illumination is None:
            self._dark = frame.counts
        elif frame.illumination.colour == self._colour:
            self._counts[frame.number] = frame.counts
            self._ready[frame.number] = self._executor.submit(self._prepare, frame)

    def join(self) -> None:
        """Begin to join the frames that were added, all of the burst; return at once."""
        self._joined = self._executor.submit(self._join)

    @property
    def joined(self) -> JoinedBurst | None:
        """The joined frames, after `finish`; None if there are not two that can be joined."""
        return None if self._joined is None else self._joined.result()

    def finish(self) -> Mapping[int, AssessedFrame]:
        """Wait until every frame is prepared; return them by the number of their frame."""
        return {number: future.result() for number, future in self._ready.items()}

    def _prepare(self, frame: Frame) -> AssessedFrame:
        prepared = None
        with suppress(FrameError):  # its verdict says why
            refract = self._refract and self._looked is not None
            prepared = self._bursts.prepare(frame.counts, self._dark, refract=refract, **self._options)
        if prepared is not None and self._looked is not None:
            self._looked(prepared.look.stage.picture, frame.simulated)
            self._looked = None
        return AssessedFrame(self._assessor.assess(frame.counts, self._dark, self._begin_s), prepared)

    def _join(self) -> JoinedBurst | None:
        ready = self.finish()
        if len(ready) < 2:
            return None
        numbers = list(ready)
        order, unusable = ranked([frame.verdict for frame in ready.values()])
        prepared = {
            place: frame.prepared for place, k in enumerate(order) if (frame := ready[numbers[k]]).prepared is not None
        }
        if len(prepared.keys() - unusable.keys()) < 2:
            return None
        counts = [self._counts[numbers[k]] for k in order]
        joined = self._bursts.join(counts, self._dark, unusable, prepared)
        return JoinedBurst(tuple(numbers[k] for k in order), joined)
