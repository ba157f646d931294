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
# # The motion model
# A camera alone sees the world up to scale. Someone who walks through it gives scale
# away: from how the posture changes, a network says how many metres the pelvis must
# have moved from one frame to the next. It sees no displacement, no heading and no
# gravity; that, and robustness to errors of estimated postures, is what matters.

# %%
import json
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image

import bodyslam_jax as bs
from bodyslam_jax import motion

# %config InlineBackend.figure_formats = ["jpeg"]
plt.rcParams["figure.dpi"] = 70
body = bs.load_body_model()
model = bs.load_motion_model()
about = json.loads(model.about)
print(model.past, "past frames;", about["data"], "·", about["licence"])

# %% [markdown]
# ## A walk it has not seen
# Eight trials of two subjects that were not trained on come with the package. `place`
# puts them on the body model: the path is scaled by leg length, or feet would skate.

# %%
clips = motion.read_motion(
    Path(bs.__file__).parent / "simulation" / "assets" / "walking.npz"
)
trials = motion.place(body, clips)
trial = max(trials, key=lambda trial: len(trial.trans))
print(trial.clip.name, len(trial.trans), "frames at", trial.clip.fps)


def turns(poses):
    return jaxlie.SO3.exp(jnp.asarray(poses, jnp.float32)).as_matrix()


@jax.jit
def predict(poses):
    return motion.predict(
        model,
        body,
        turns(poses[:, 0]),
        poses[:, 1:],
        jnp.asarray(trial.shape, jnp.float32),
        jnp.ones(len(poses), bool),
    )


true_turns = np.asarray(turns(trial.clip.poses[:, 0]))
true = np.einsum("tba,tb->ta", true_turns[:-1], np.diff(trial.trans, axis=0))

# %% [markdown]
# The same walk with postures as a regressor gives them: slow errors of 9° per joint
# axis, half as much again at hands and feet, and a little white noise.

# %%
key = jax.random.key(0)
noise = motion.drift(
    key, len(trial.trans), jnp.deg2rad(jnp.float32(9)), jnp.deg2rad(jnp.float32(0.4))
)
noise = noise.at[:, 0].set(0.0)
estimated = motion.disturb(jnp.asarray(trial.clip.poses), noise)
figure, axes = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
for label, poses in (("clean", jnp.asarray(trial.clip.poses)), ("9° drift", estimated)):
    said = predict(poses)
    valid = np.asarray(said.valid)
    for i, axis in enumerate(axes):
        value = 1e3 * np.asarray(said.translation)[:, i]
        sigma = 1e3 * np.sqrt(np.asarray(said.covariance)[:, i, i])
        frames = np.arange(len(value))[valid]
        (line,) = axis.plot(frames, value[valid], label=label)
        axis.fill_between(
            frames,
            (value - 2 * sigma)[valid],
            (value + 2 * sigma)[valid],
            color=line.get_color(),
            alpha=0.15,
        )
for i, (axis, name) in enumerate(zip(axes, ("left", "up", "forward"))):
    axis.plot(np.arange(1, len(true) + 1), 1e3 * true[:, i], "k", lw=1, label="true")
    axis.set(xlabel="frame", ylabel=f"mm {name} a frame")
_ = axes[0].legend()

# %% [markdown]
# ## How good it is
# Ratio is mean error over mean step; slope is the projection of predicted on true
# displacement, whose error would be the error of scale; spread is its standard
# deviation from sequence to sequence. `nees` is the normalised error squared per
# degree of freedom: 1 if the predicted covariance is right. `corr_1` and `corr_30` are
# the correlation of errors one frame and one second apart: frames are not independent.

# %%
rows = motion.compare({"default": model}, body, clips, seeds=2)
print(motion.write_table([row for row in rows if row["class"] == "all"]))

# %%
figures = Path(tempfile.mkdtemp())
motion.draw_errors(model, body, clips, figures / "errors.png")
Image(figures / "errors.png", width=800)

# %% [markdown]
# ## Scale in closed form
# A camera that moves along with the person, its path known only up to scale: predicted
# displacement against observed one is linear in the scale.

# %%
rng = np.random.default_rng(0)
t = len(trial.trans)
wobble = np.cumsum(rng.normal(0, 0.02, (t, 3)), 0)
camera = 0.8 * (trial.trans - trial.trans[0]) + [0, 0, -3] + wobble
for label, poses in (("clean", jnp.asarray(trial.clip.poses)), ("9° drift", estimated)):
    found = motion.scale_from_motion(
        predict(poses), true_turns, camera / 3.0, trial.trans - camera
    )
    print(f"{label}: {found.value:.3f} ± {found.standard_error:.3f}; 3 is right")

# %% [markdown]
# ## Going on
# From two postures the model continues on its own, for seconds, without exploding.

# %%
start = 30
going_on = motion.rollout(
    model,
    body,
    jnp.asarray(true_turns[start - 20 : start]),
    jnp.asarray(trial.clip.poses[start - 20 : start, 1:]),
    jnp.asarray(trial.shape, jnp.float32),
    120,
)
motion.draw_rollout(going_on, body, trial.shape, figures / "rollout.png", every=10)
Image(figures / "rollout.png", width=800)
