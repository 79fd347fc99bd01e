"""`diffuscope simulate`: plan of the effects of a scene, and its simulated exposures written as files."""

from dataclasses import dataclass
from pathlib import Path

from device.config.head_file import InstrumentSpec
from device.sim import scene_files
from device.sim.optical_setup import Scene
from device.sim.plan import Decision, decide, format_plan


@dataclass(frozen=True)
class SelectedEffects:
    """Selection of effects on the command line: all of them, only those named, or without those named."""

    everything: bool = False
    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()

    def __call__(self, scene: Scene) -> tuple[Decision, ...]:
        """Return the decision on every effect of a scene; SettingError for a name that no effect has."""
        return decide(scene, everything=self.everything, only=self.only, without=self.without)


def explain_plan(spec: InstrumentSpec, selected: SelectedEffects) -> str:
    """Return the plan of a scene as a text table without rendering; SpecError without the tables [optics] and [sim]."""
    return format_plan(selected(Scene(spec, spec.light.colour)))


def write_scene(spec: InstrumentSpec, folder: Path, selected: SelectedEffects, count: int = 1) -> str:
    """Write `count` exposures of a scene with their truth, and return its plan with the computing times as text.

    Files and errors as in `scene_files.simulate`.
    """
    world = scene_files.simulate(spec, folder, selected, count)
    return format_plan(world.plan, world.setup(spec.light.colour).spent_ms)
