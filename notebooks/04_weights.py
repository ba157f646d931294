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
# # Which weight matters for what?
# Each term of the cost has a weight λ, the mean inverse variance σ⁻² of its
# measurements. Here one λ after the other is made a hundred times smaller, which nearly
# leaves the term out, on four sequences; what that does to the estimate is shown with
# its standard error. A sequence's solves differ in their weights alone, so they are one
# `vmap`. **Everything here is simulated.**

# %%
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Markdown
from scipy.stats import t as student

import bodyslam_jax as bs

# %config InlineBackend.figure_formats = ["jpeg"]
plt.rcParams["figure.dpi"] = 80

# %% [markdown]
# ## Four sequences
# Two seconds each of a walker whom a hand-held camera goes along with. Cameras and
# landmarks are held where bundle adjustment left them: what is looked at is how the
# person and the scale are weighed. `stack_cases` brings the problems to one size, so that
# all solves are calls of one compiled program.

# %%
cases = [
    bs.simulate_case(name, family="follow", frames=60)
    for name in ("E1", "M1", "M2", "M3")
]
problems, states = bs.stack_cases(cases, hold=("cameras", "landmarks"))
terms = [n for n in problems.names if n not in ("landmarks", "landmark_prior")]
print(*terms)

# %% [markdown]
# ## One weight after the other

# %%
FACTOR = 0.01
# Factors on the λ's; in the first row they are as they are.
rows = np.concatenate([np.ones((1, len(terms))), 1 - (1 - FACTOR) * np.eye(len(terms))])
QUANTITIES = {  # unit, and how it is computed from the errors of an estimate
    "estimated scale": ("%", lambda s, e: 100 * s),
    "place in the world": ("mm, J-ATE", lambda s, e: 1e3 * e["j_ate_se3"]),
    "posture": ("mm, PA-MPJPE", lambda s, e: 1e3 * e["pa_mpjpe"]),
    "standing feet": ("mm, sliding per frame", lambda s, e: 1e3 * e["foot_sliding"]),
}


def study(case, problem, state):
    """Returns the quantities of one sequence for each row of weights."""
    weights = bs.weights(problem)

    def one(factors):
        changed = {name: weights[name] * f for name, f in zip(terms, factors)}
        return bs.solve(bs.with_weights(problem, **changed), state).state

    found = jax.vmap(one)(jnp.asarray(rows))
    errors = jax.vmap(lambda y: bs.evaluate(case.trajectories(y), case.truth))(found)
    relative = found.scale / case.map_scale - 1
    return [np.asarray(of(relative, errors)) for _, of in QUANTITIES.values()]


of_case = lambda tree, k: jax.tree.map(lambda x: x[k], tree)
seen = np.array(
    [study(c, of_case(problems, k), of_case(states, k)) for k, c in enumerate(cases)]
)  # sequences, quantities, rows of weights

# %%
change = seen[..., 1:] - seen[..., :1]
standard_error = lambda x: x.std(0, ddof=1) / np.sqrt(len(cases))
mean, error = change.mean(0), standard_error(change)  # quantities, terms
clear = np.abs(mean) > 3 * error
usual, usual_error = seen[..., 0].mean(0), standard_error(seen[..., 0])
figure, axes = plt.subplots(1, 4, figsize=(13, 3.8), sharey=True, layout="constrained")
for q, (axis, (name, (unit, _))) in enumerate(zip(axes, QUANTITIES.items())):
    for i in range(len(terms)):
        colour = "tab:red" if clear[q, i] else "0.6"
        axis.errorbar(mean[q, i], i, xerr=error[q, i], fmt="o", capsize=3, color=colour)
    axis.axvline(0, color="0.5", lw=0.8)
    short = unit.split(",")[0]
    axis.set_title(f"{name}\n{usual[q]:.1f} ± {usual_error[q]:.1f} {short}", fontsize=10)
    axis.set_xlabel(f"change, {unit}")
    axis.set_yticks(range(len(terms)), terms)
    axis.grid(alpha=0.3)
axes[0].invert_yaxis()

# %% [markdown]
# What a λ that is a hundred times smaller changes: mean over the sequences and its
# standard error, red where it is beyond three of them. Right of zero the scale is larger,
# and errors are. Titles: the value with the weights as they are (the scale's deviation
# from the true one).


# %%
def strongest(q, unit, count=3):
    """Describes the largest changes that are beyond three standard errors."""
    order = [i for i in np.argsort(-np.abs(mean[q])) if clear[q, i]][:count]
    said = [f"`{terms[i]}` {mean[q, i]:+.1f} ± {error[q, i]:.1f} {unit}" for i in order]
    return ", ".join(said) or "none"


chance = 2 * student.sf(3, len(cases) - 1) * clear.size
idle = [f"`{name}`" for name, any_ in zip(terms, clear.any(0)) if not any_]
Markdown(
    f"**Answer** (simulated, {len(cases)} sequences): without a term, nearly, these "
    f"change by more than three standard errors ({clear.sum()} of {clear.size} do, where "
    f"chance alone would give {chance:.0f}), the largest first:\n\n"
    + "".join(
        f"- {name}: {strongest(q, unit.split(',')[0])}\n"
        for q, (name, (unit, _)) in enumerate(QUANTITIES.items())
    )
    + f"- no clear effect on any of these: {', '.join(idle) or 'none of the terms'}\n"
)

# %% [markdown]
# A cost cannot say which weight is right: it falls wherever a λ does. Errors against a
# truth can, and they differentiate through the solver (`jax.grad`, by the implicit
# function theorem; `docs/toolkit.md`). What was so learnt on four
# people did not hold for others (`benchmarks/experiments.md`).
