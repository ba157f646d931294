# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # While the video runs
# `bs.Online` estimates camera and people frame by frame, in metres as soon as somebody
# has told the scale. Here a rendered clip is replayed, so that the truth is known:
# someone walks through a room, and a camera goes along. `bodyslam live SOURCE` does the
# same with a file, a camera or a stream, finds people by networks, and shows a page.
# [How it works](../docs/live.md), [how exact it is](../benchmarks/online.md).

# %%
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import bodyslam_jax as bs
from bodyslam_jax import evaluation, io, simulation, view

# %config InlineBackend.figure_formats = ["jpeg"]
plt.rcParams["figure.dpi"] = 70
jax.config.update("jax_enable_x64", True)
source = simulation.demo_scene(Path(tempfile.mkdtemp()) / "scene")
sequence = bs.read_sequence(source)
print(f"{sequence.num_frames} frames, {sequence.fps:.0f} a second")

# %% [markdown]
# ## Compiled before the first frame
# `prepare` compiles all programs, or takes them from JAX's cache: no frame waits. With
# `threads=False` windows are solved within `update`, so that the same frames give the
# same estimates, whatever the machine; the command solves them in a second thread.

# %%
online = bs.Online(
    intrinsics=sequence.intrinsics,
    fps=sequence.fps,
    config=bs.Config().for_simulated_people(),
    threads=False,
    name="demo",
)
online.prepare()

# %% [markdown]
# ## Frame by frame
# Images and keypoints go in, in any order of people; camera, people and scale come out.
# A map begins where two views have parallax (`starting` before), and the scale is NaN
# until the person's steps have told it. Before a camera that stands still for 3 s the
# status is `fixed`: sizes come from people alone then.

# %%
keypoints = np.concatenate(
    [sequence.keypoints.uv, sequence.keypoints.confidence[..., None]], axis=-1
)
estimates, pictures = [], {}
shown = np.linspace(0.2, 0.95, 4) * sequence.num_frames
for k, image in enumerate(io.frames(sequence)):
    now = online.update(image, float(sequence.timestamps[k]), keypoints[:, k])
    if k and now.status != estimates[-1].status:
        print(f"{now.timestamp:.2f} s: {now.status}")
    estimates.append(now)
    if k in shown.astype(int):
        pictures[k] = image[..., ::-1], online.drawn(now), online.points.copy()
print("\n".join(now.notes))

# %% [markdown]
# ## What was known at the time
# Joints as they were drawn over the running video, and the points that are followed.

# %%
figure, axes = plt.subplots(1, len(pictures), figsize=(14, 3))
for axis, (k, (image, people, points)) in zip(axes, pictures.items()):
    axis.imshow(image)
    axis.plot(*points.T, ".", color="white", markersize=1)
    for _, uv, _ in people:
        axis.plot(*uv.T, ".", color="red", markersize=4)
    axis.set_title(f"{sequence.timestamps[k]:.1f} s")
    axis.axis("off")
figure.tight_layout()

# %% [markdown]
# ## The scale becomes sure
# Metres per unit of the map, with its standard deviation, after each frame.

# %%
times = np.array([e.timestamp for e in estimates])
scale, sigma = np.array([(e.scale, e.scale_sigma) for e in estimates]).T
plt.figure(figsize=(7, 3))
plt.plot(times, scale)
plt.fill_between(times, scale - sigma, scale + sigma, alpha=0.3)
plt.xlabel("time, s")
plt.ylabel("m per unit of the map")
latency = 1000 * np.array([e.latency for e in estimates])
print(f"a frame takes {np.median(latency):.0f} ms, one with a window more")

# %% [markdown]
# ## The result
# `finish` solves what is left and returns the usual `Result`, whose windows were
# smoothed one after another. The dashed lines are the truth; sizes are as estimated.

# %%
result = online.finish()
print(*result.summary["headline"], sep="\n")
truth = evaluation.read_groundtruth(source / "groundtruth", online.body)
moved = evaluation.umeyama(
    truth.T_WC[:, :3, 3], result.T_WC[:, :3, 3], with_scale=False
)
figure, plan = plt.subplots(figsize=(7, 4))
pelvis = np.where(result.present[0, :, None], result.joints[0, :, 0], np.nan)
for found, true, label in (
    (result.T_WC[:, :3, 3], truth.T_WC[:, :3, 3], "camera"),
    (pelvis, truth.joints[0, :, 0], "person"),
):
    found = moved.apply(found)
    (line,) = plan.plot(found[:, 0], found[:, 2], label=label)
    plan.plot(true[:, 0], true[:, 2], "--", color=line.get_color())
plan.set_aspect("equal")
plan.set_xlabel("x, m")
plan.set_ylabel("z, m")
plan.legend()

# %%
print(evaluation.to_table(evaluation.evaluate(result, truth)))
