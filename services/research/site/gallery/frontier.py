"""
Accuracy against time
=====================

How much accuracy does a method buy, and for how much time? ``diffuscope.frontier`` runs
every method, at every bin and number of rounds, on one frame whose truth is known.
"""

# %%
# A small sensor, so that the whole comparison takes seconds. A scene is a head file with
# the table ``[sim]``.

from pathlib import Path
from tempfile import mkdtemp

import diffuscope
import matplotlib.pyplot as plt

SCENE = """
name = "Small scene"
camera = {backend = "sim", sensor = "quantalux", rows = 180, cols = 320, pitch_um = 30.24}
light = { backend = "sim" }
optics = { field_deg = 33.4 }
sim = { seed = 3, peak_e = 15000 }
"""
path = Path(mkdtemp()) / "small.toml"
path.write_text(SCENE)
scene = diffuscope.simulate(path)
result = diffuscope.frontier(scene=scene, repeats=3)

# %%
# ``points`` has one entry per method, bin and number of rounds; ``pareto`` marks those
# that no other beats in both time and accuracy. PSNR is that after the best fit of scale
# and offset, inside the lit field.

figure, axis = plt.subplots(figsize=(9, 5), layout="constrained")
for name in dict.fromkeys(point.method for point in result.points):
    own = [point for point in result.points if point.method == name]
    times_ms = [1e3 * point.seconds_median for point in own]
    axis.plot(times_ms, [point.psnr_db for point in own], "o", label=name)
best = [point for point in result.points if point.pareto]
edge = sorted((1e3 * point.seconds_median, point.psnr_db) for point in best)
axis.step(*zip(*edge, strict=True), "k", where="post", lw=1, label="best within the time")
axis.set(xscale="log", xlabel="time from frame to picture [ms]", ylabel="PSNR [dB]")
axis.legend()

# %%
# The table of the best points, fastest first:

for point in sorted(best, key=lambda point: point.seconds_median):
    figures = f"{1e3 * point.seconds_median:7.1f} ms  {point.psnr_db:5.2f} dB"
    print(f"{figures}  {point.method}, bin {point.bin}, {point.rounds} rounds")
