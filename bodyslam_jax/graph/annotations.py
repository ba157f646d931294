"""The array fields of a module and the axes that their jaxtyping annotations name."""

import dataclasses
import functools
import typing
from typing import Any

import equinox as eqx
from jaxtyping import AbstractArray


@functools.cache
def array_annotations(kind: type[eqx.Module]) -> dict[str, type[AbstractArray]]:
    """Returns the fields annotated with a jaxtyping array, in their declared order.

    Annotations that are strings (`from __future__ import annotations`) are evaluated.
    """
    fields = dataclasses.fields(kind)
    if any(isinstance(field.type, str) for field in fields):
        types: dict[str, Any] = typing.get_type_hints(kind)
    else:
        types = {field.name: field.type for field in fields}
    return {
        field.name: types[field.name]
        for field in fields
        if isinstance(types[field.name], type)
        and issubclass(types[field.name], AbstractArray)
    }


def fields_with_axes(kind: type[eqx.Module], axes: tuple[str, ...]) -> tuple[str, ...]:
    """Returns the array fields whose leading axes are these, such as `("h", "t")`."""
    return tuple(
        name
        for name, array in array_annotations(kind).items()
        if tuple(array.dim_str.split()[: len(axes)]) == axes
    )
