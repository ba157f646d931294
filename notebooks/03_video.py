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
# # From a video to metres
# A folder with a video and people's keypoints goes in; the camera's path, the people and
# a map come out, in metres. Here the video is rendered, so that the truth is known and
# no file is needed: someone walks through a room, and a camera goes along. With a video
# of your own, `source` is its folder.

# %%
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import bodyslam_jax as bs
from bodyslam_jax import diagnostics, evaluation, io, simulation, view

# %config InlineBackend.figure_formats = ["jpeg"]
plt.rcParams["figure.dpi"] = 70
jax.config.update("jax_enable_x64", True)
source = simulation.demo_scene(Path(tempfile.mkdtemp()) / "scene")
print(sorted(path.name for path in source.iterdir()))

# %% [markdown]
# ## Three lines

# %%
sequence = bs.read_sequence(source)
config = bs.Config(uncertainty=False).for_simulated_people()
result = bs.run(sequence, config)
print(*result.summary["headline"], sep="\n")

# %% [markdown]
# Without `uncertainty=False` it also says how sure it is, and takes longer. Everything
# in `result` is a plain array, in a world with y up and the floor at 0.

# %%
for name in ("timestamps", "T_WC", "landmarks", "poses", "trans", "betas", "joints"):
    print(f"{name:12}", getattr(result, name).shape)

# %% [markdown]
# ## What the camera saw
# The estimated body over some of the frames.

# %%
body = bs.load_body_model()
chosen = np.linspace(0, sequence.num_frames - 1, 4).astype(int)
figure, axes = plt.subplots(1, 4, figsize=(14, 3))
for k, image in enumerate(io.frames(sequence)):
    if k in chosen:
        axis = axes[np.flatnonzero(chosen == k)[0]]
        axis.imshow(view.draw_frame(image, result, body, k)[..., ::-1])
        axis.set_title(f"{result.timestamps[k]:.1f} s")
        axis.axis("off")
figure.tight_layout()

# %% [markdown]
# ## From any side
# The same in 3D: play it, turn it, follow the person, look through the camera. From the
# side the feet should stand on the floor and the knees bend as knees do; from above the
# path should be that of a walk. Run the cell to see it: its page, about 2 MB, is not kept
# in this file.

# %%
result.view()

# %% [markdown]
# ## Where everybody went, and how fast
# The dashed lines are the truth. For the comparison the estimate is moved and turned as
# a whole, because no video says where north is; its size is left as it was estimated.

# %%
truth = evaluation.read_groundtruth(source / "groundtruth", body)
moved = evaluation.umeyama(
    truth.T_WC[:, :3, 3], result.T_WC[:, :3, 3], with_scale=False
)
figure, (plan, speed) = plt.subplots(1, 2, figsize=(12, 4))
# A person who is not found in a frame is nowhere there.
pelvis = np.where(result.present[0, :, None], result.joints[0, :, 0], np.nan)
for points, true, label in (
    (result.T_WC[:, :3, 3], truth.T_WC[:, :3, 3], "camera"),
    (pelvis, truth.joints[0, :, 0], "person"),
):
    found = moved.apply(points)
    (line,) = plan.plot(found[:, 0], found[:, 2], label=label)
    plan.plot(true[:, 0], true[:, 2], "--", color=line.get_color())
plan.set_aspect("equal")
plan.set_xlabel("x, m")
plan.set_ylabel("z, m")
plan.legend()
for facts, label in (
    (diagnostics.camera_statistics(result), "camera"),
    (diagnostics.person_statistics(result, 0), "person"),
):
    speed.plot(result.timestamps, facts.speed, label=label)
    print(f"{label}: {facts.distance:.2f} m, {facts.mean_speed:.2f} m/s")
speed.set_ylim(0)
speed.set_xlabel("time, s")
speed.set_ylabel("m/s")
speed.legend()

# %% [markdown]
# ## How far off
# Errors in mm, after the alignments of the paper; simulated measurements, rendered
# images. `Sim(3)` rows also correct the size, and so say what is left beside it.

# %%
print(evaluation.to_table(evaluation.evaluate(result, truth)))

# %% [markdown]
# ## Before the people: a map without a unit
# Without people the same video gives the camera's path and a map, but no metres: the
# unit is the median distance of the points from the first camera. What people add is
# the one number `scale`, metres in that unit.

# %%
print(f"scale {result.scale:.3f} m per unit of the map")
figure = plt.figure(figsize=(7, 4))
near = result.landmarks[np.abs(result.landmarks).max(axis=1) < 8]
plt.scatter(near[:, 0], near[:, 2], 2, near[:, 1], cmap="viridis")
plt.plot(*result.T_WC[:, [0, 2], 3].T, "k", label="camera")
plt.colorbar(label="height of the points, m")
plt.axis("equal")
plt.xlabel("x, m")
plt.ylabel("z, m")
plt.legend()
