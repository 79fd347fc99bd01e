"""Factor of this machine over the reference, for the times on a Raspberry Pi 5: `make bench-pi`."""

from pathlib import Path

from device.clock import SystemClock
from device.config.head_file import load_head
from device.recon.model.fft_plans import Planner, processor_name
from device.recon.reconstructor import Reconstructor
from device.sim.scene_files import simulate_exposure
from services.research.fft_time import PI5_FACTOR, REFERENCE_PAIR_S, REFERENCE_SHAPE, pair_s
from tests.simulated import SCENES

MODEL = Path("/proc/device-tree/model")  # of a board; a PC has none
REPEATS = 30


def main() -> None:
    """Print the model, the time of a planned FFT pair and of a reconstruction, and the factor."""
    clock, planner = SystemClock(), Planner(None)
    model = MODEL.read_text(encoding="utf-8").strip("\0\n") if MODEL.exists() else processor_name()
    board = "" if "Raspberry Pi 5" in model else ": this is no Raspberry Pi 5, the factor is that of this machine"
    print(f"{model}{board}")
    shortest_s = pair_s(planner, REFERENCE_SHAPE, clock, REPEATS)
    frame = simulate_exposure(load_head(SCENES / "healthy.toml"))
    make = Reconstructor(frame.calibration, frame.counts.shape, planner, clock, refract=False, timed=False)
    make(frame.counts)  # compiles its kernels
    begin_s = clock.now_s()
    make(frame.counts)
    solved_s = clock.now_s() - begin_s
    print(f"one planned FFT pair, {REFERENCE_SHAPE[0]} x {REFERENCE_SHAPE[1]}: {1000 * shortest_s:.1f} ms")
    print(f"one reconstruction of such a frame: {solved_s:.2f} s, {solved_s / shortest_s:.0f} FFT pairs")
    print(
        f"factor: {shortest_s / REFERENCE_PAIR_S:.2f} (reference {1000 * REFERENCE_PAIR_S:.0f} ms, "
        f"Raspberry Pi 5 stated as {PI5_FACTOR:g}, not measured)"
    )


if __name__ == "__main__":
    main()
