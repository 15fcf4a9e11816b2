"""First steps: measure a hysteresis, identify a model, predict, invert, report.

The cells (`# %%`) are those of a notebook: open this file in VS Code, Spyder or, by jupytext, in Jupyter; or run it
by `python examples/first_steps.py`. It takes a few seconds: the rig is emulated and its clock is virtual.
"""

# %% [markdown]
# Everything that a notebook needs is in `bench`.

# %%
import numpy as np

import bench

# %% [markdown]
# A rig is opened by its name, or by the path of a rig file of your own. `vo2` is a microcantilever that bends with
# the temperature of its plate. Leaving the block brings every device into its safe state.

# %%
with bench.open_rig("vo2") as rig:
    rig.devices["tec"].set(40.0).wait()
    for name, value in rig.measure().items():
        print(f"{name:24} {value:.4g}")

# %% [markdown]
# A protocol measures step by step. This one is short; without parameters it takes the 3000 set-points of the paper.

# %%
run = bench.run("damped-oscillation", "vo2", out="recordings", half_cycles=12, increment=2.0)
print(run)
print(run.readings)

# %% [markdown]
# A model is identified from the run, and says how well it fits. It can be saved as a file and loaded again.

# %%
model = bench.identify(run, "preisach-nonmonotonic", levels=10, plane=(30.0, 70.0))
print(model)
model.file.save(run.folder / "model.json")
loaded = bench.load(run.folder / "model.json")

# %% [markdown]
# It predicts the curvature (1/m) along any sequence of temperatures (°C). The same temperature gives different
# curvatures: this is the hysteresis.

# %%
temperatures = np.array([30.0, 58.0, 80.0, 58.0])
curvatures = bench.predict(loaded, temperatures)
print(np.column_stack([temperatures, curvatures]).round(1))

# %% [markdown]
# Its inverse gives the temperatures that bring the curvature to targets, one after another.

# %%
targets = [400.0, 1200.0, 800.0]
inverted = bench.invert(loaded, targets)
for target, setpoint, flag in zip(targets, inverted.setpoints, inverted.flags, strict=True):
    print(f"{target:6.0f} 1/m at {setpoint:5.2f} °C: {flag}")

# %% [markdown]
# The report has tables of the run and the models, and draws its figures.

# %%
results = bench.report(run, [model])
print(results["figures"])
