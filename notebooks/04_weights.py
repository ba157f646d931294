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
# # Weights of the cost
# Each term of the cost is divided by a standard deviation σ (the paper's λ is σ⁻²). What
# they do to the estimate can be looked at, since a solve maps over them, and learnt,
# since it differentiates: at the optimum the gradient of the cost is zero, which says
# how the optimum moves with the weights (implicit function theorem; nothing is
# unrolled). **Everything here is simulated.**

# %%
import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import bodyslam_jax as bs
from bodyslam_jax import experiments, solver

# %config InlineBackend.figure_formats = ["jpeg"]
plt.rcParams["figure.dpi"] = 70

# %% [markdown]
# ## A short sequence
# Cameras are held where bundle adjustment left them and landmarks are left out: what is
# looked at is how the person is weighed, and a solve takes a second. `make_trial` solves
# the problem once; with other weights the solution is near.

# %%
case = bs.simulate_case("M2", family="follow", frames=80)
trial = experiments.make_trial(case, case.prepare(), hold_cameras=True)
names = experiments.names_of(trial.problem)
print(names)

# %% [markdown]
# ## One weight after the other
# Every σ (or robust scale) times 1/4 to 4, the others as they are: one mapped solve.

# %%
factors = np.array([0.25, 0.5, 1.0, 2.0, 4.0])
rows = np.repeat(np.eye(len(names))[:, None], len(factors), 1)
logs = jnp.asarray(rows * np.log(factors)[None, :, None]).reshape(-1, len(names))
schedule = (solver.Stage(max_steps=15, rtol=1e-6),)


@eqx.filter_jit
def explore(trial, logs):
    def one(log):
        _, cost, found = experiments.outcome(trial, names, log, schedule)
        return found | {"cost": cost, "error": experiments.training_error(found)}

    return jax.lax.map(one, logs, batch_size=4)


seen = {k: np.asarray(v).reshape(len(names), -1) for k, v in explore(trial, logs).items()}

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
for i, name in enumerate(names):
    axes[0].plot(factors, seen["cost"][i], "o-", label=name)
    axes[1].plot(factors, 1 / seen["scale"][i], "o-")
    axes[2].plot(factors, 1e3 * seen["j_ate_se3"][i], "o-")
axes[0].set(ylabel="cost at the optimum", yscale="log")
axes[1].set(ylabel="estimated / true scale")
axes[2].set(ylabel="J-ATE after SE(3), mm")
for axis in axes:
    axis.set(xlabel="factor on σ", xscale="log")
    axis.set_xticks(factors, [f"{factor:g}" for factor in factors])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
_ = axes[0].legend(fontsize=8)

# %% [markdown]
# The cost says nothing about weights: it falls wherever a σ grows. The error does.
#
# ## Its gradient, through the solver
# By the implicit function theorem, beside central differences of the solves above.

# %%
zero = jnp.zeros(len(names))
value, gradient, state = experiments.error_and_gradient(trial, names, zero, trial.state)
step = np.log(factors[3]) - np.log(factors[1])
slopes = (seen["error"][:, 3] - seen["error"][:, 1]) / step
print(f"error {float(value):.3f}")
for name, g, slope in zip(names, np.asarray(gradient), slopes):
    print(f"{name:>14}  gradient {g:+8.3f}   between 1/2 and 2 {slope:+8.3f}")

# %% [markdown]
# ## A few steps downhill
# On one short sequence this only fits its accidents; `bodyslam experiment weights`
# learns on several and reports the gain on others.

# %%
learned = experiments.learn_weights([trial], steps=5, rate=0.2)
figure, axes = plt.subplots(1, 2, figsize=(11, 3.2), layout="constrained")
axes[0].plot(learned.history, "o-")
axes[0].set(xlabel="step", ylabel="error, 1")
axes[1].barh(names, np.exp(learned.log))
axes[1].axvline(1, color="0.5", lw=0.8)
_ = axes[1].set(xlabel="factor on σ", xscale="log")
