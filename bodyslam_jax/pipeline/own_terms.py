"""User-defined factors and variables in the joint problem of `run`.

They are added to the complete problem, so that first values and the initial scale
depend on the video alone. While standing feet are held (`contact_stage.py`), cameras,
map and scale are constants, and so are the user's variables.
"""

import dataclasses
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many

import jax.numpy as jnp
import numpy as np

from bodyslam_jax import graph, solver
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.pipeline.joint_problem import Prepared
from bodyslam_jax.types import OwnFactor, OwnVariable

Factors = Many[graph.Factor] | Callable[[graph.State], Many[graph.Factor]]
"""Factors, or a function that makes them from the initial state of the joint solve: `t`
frames, `h` people, landmarks and cameras in units of the map."""


@dataclasses.dataclass(frozen=True)
class OwnTerms:
    """Factors and variables that a user adds to the joint problem."""

    factors: Factors = ()
    variables: Mapping[str, graph.Variable] = dataclasses.field(default_factory=dict)
    """Named globals that `factors` depend on, with their priors."""

    def __bool__(self) -> bool:
        return callable(self.factors) or bool(self.factors or self.variables)

    def added_to(self, prepared: Prepared) -> Prepared:
        """Adds these terms to the prepared problem and its state.

        **Raises:** `InputError` if a factor does not fit the problem, naming it.
        """
        if not self:
            return prepared
        try:
            problem, state = prepared.problem.with_variables(
                prepared.state, **self.variables
            )
            own = self.factors
            own = own(prepared.state) if callable(own) else own
            problem = problem.with_factors(*own)
        except ValueError as error:
            raise InputError(f"factors: {error}") from error
        return dataclasses.replace(prepared, problem=problem, state=state)

    def found(
        self,
        before: graph.Problem,
        problem: graph.Problem,
        state: graph.State,
        marginals: solver.Marginals | None,
    ) -> tuple[tuple[OwnVariable, ...], tuple[OwnFactor, ...]]:
        """Returns values of the variables and misfits of the factors at the optimum.

        `state` is the optimum of `problem`, which is `before` with these terms added.
        Without `marginals` the sigmas of variables are NaN.
        """
        if not self:
            return (), ()
        values = problem.named(state.globals)
        sigma = {}
        if marginals is not None:
            sigma = problem.named(jnp.sqrt(jnp.diagonal(marginals.globals)))
        numbers = lambda x: tuple(np.atleast_1d(np.asarray(x, float)).tolist())
        variables = []
        for name, given in self.variables.items():
            unknown = jnp.full_like(values[name], jnp.nan)
            variables.append(
                OwnVariable(
                    name,
                    numbers(values[name]),
                    numbers(sigma.get(name, unknown)),
                    numbers(given.value),
                    numbers(np.broadcast_to(given.sigma, np.shape(values[name]))),
                )
            )
        # Priors of variables precede the user's factors.
        first = len(before.factors)
        factors = [
            _misfit(name, factor, state)
            for name, factor in zip(problem.names[first:], problem.factors[first:])
            if not isinstance(factor, graph.GlobalPrior)
        ]
        return tuple(variables), tuple(factors)


def _misfit(name: str, factor: graph.Factor, state: graph.State) -> OwnFactor:
    """Returns the misfit of a factor; residuals of exactly 0 count as missing."""
    residual = np.asarray(graph.residual_of(factor, state))
    count = int(np.count_nonzero(residual))
    cost = float(factor.cost(state))
    return OwnFactor(name, count, cost, (2 * cost / count) ** 0.5 if count else 0.0)
