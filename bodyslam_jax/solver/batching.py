"""Batches of problems: in turn on a CPU, and shared out among several devices.

A core is busy with one problem. Mapped at once, small products become batches of small
products, branches that one problem skips are taken for all, and memory grows with the
batch: six starts of 300 frames took 1.4 times as long as in turn. A GPU has room for
all at once.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bodyslam_jax.geometry.lengths import is_alone, is_traced
from bodyslam_jax.solver.compilation import quick_jit


def sequential_vmap(
    function: Callable[..., Any], alone: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """Returns the function of pytrees such that `vmap` maps it in turn on a CPU.

    Within `jit` that is a loop in one program. Otherwise `alone`, the function as a
    compiled program, is called for each, so that mapping compiles nothing more.
    """

    def call(*args):
        if jax.default_backend() != "cpu":
            return function(*args)
        arrays, static = eqx.partition(args, eqx.is_array)
        form = None

        def arrays_of(function, arrays):
            nonlocal form
            found = function(*eqx.combine(arrays, static))
            found, form = eqx.partition(found, eqx.is_array)
            return found

        @jax.custom_batching.custom_vmap
        def one(arrays):
            return arrays_of(function, arrays)

        @one.def_vmap
        def mapped(size, is_mapped, arrays):
            leaves, treedef = jax.tree.flatten(arrays)
            rows = [x for x, m in zip(leaves, jax.tree.leaves(is_mapped)) if m]

            def with_rows(row):
                each = iter(row)
                flags = zip(leaves, jax.tree.leaves(is_mapped), strict=True)
                return treedef.unflatten([next(each) if m else x for x, m in flags])

            if alone is None or is_traced(arrays) or not is_alone():
                found = jax.lax.map(lambda row: one(with_rows(row)), rows)
            else:
                row = lambda i: with_rows([x[i] for x in rows])
                each = [arrays_of(alone, row(i)) for i in range(size)]
                found = jax.tree.map(lambda *x: jnp.stack(x), *each)
            return found, jax.tree.map(lambda _: True, found)

        found = one(arrays)
        return eqx.combine(found, form)

    return call


DEVICE_AXIS = "device"
"""Name of the mesh axis over devices."""


def vmap_over_devices(
    function: Callable[..., Any], in_axes: int | tuple[int | None, ...] = 0
) -> Callable[..., Any]:
    """Returns a compiled `jax.vmap(function, in_axes)` with the
    batch shared among devices.

    On a CPU a core can be a device: `jax.config.update("jax_num_cpu_devices", 2)`
    before any other use of JAX. Six solves of 300 frames then take 0.6 of the time that
    they take one after another. With one device it is `jax.vmap`.

    `in_axes` is 0 for arguments with a leading batch axis and `None` for shared ones,
    as one value for all arguments or one for each. Keep the returned function: calling
    it again does not compile again. Batches may have any size; results are on the first
    device, and their leaves that are no arrays are those of the function.

    **Raises:** `ValueError` if no argument is mapped, or their leading axes differ.
    """
    program = functools.partial(_shared_out, function)

    @functools.cache
    def compiled():
        return quick_jit(program)

    def call(*args):
        args = jax.tree.map(_as_array, args)
        axes = in_axes if isinstance(in_axes, tuple) else (in_axes,) * len(args)
        if len(axes) != len(args) or any(axis not in (0, None) for axis in axes):
            raise ValueError(
                f"in_axes: {in_axes} for {len(args)} arguments, expected 0 or None for "
                "each."
            )
        batch = _size_of_batch(args, axes)
        devices = tuple(jax.local_devices())[:batch]
        if is_traced(args) or not is_alone():
            return program(args, axes, devices, batch)
        everywhere = NamedSharding(
            Mesh(np.array(devices), DEVICE_AXIS), PartitionSpec()
        )
        found = compiled()(_placed(args, everywhere), axes, devices, batch)
        return _placed(found, devices[0])

    return call


def _as_array(leaf):
    return jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf


def _placed(tree, where):
    put = lambda x: jax.device_put(x, where) if eqx.is_array(x) else x
    return jax.tree.map(put, tree)


def _size_of_batch(args, axes) -> int:
    mapped = [a for a, axis in zip(args, axes, strict=True) if axis == 0]
    leaves = [x for x in jax.tree.leaves(mapped) if eqx.is_array(x)]
    sizes = {x.shape[:1] for x in leaves}
    if len(sizes) != 1 or sizes & {(), (0,)}:
        raise ValueError(
            f"leading axes of what is mapped: {sorted(sizes)}, expected one size for "
            "all, of at least 1."
        )
    return sizes.pop()[0]


def _shared_out(function, args, axes, devices, batch):
    arrays, static = eqx.partition(args, eqx.is_array)
    form = None

    def one(*arrays):
        nonlocal form
        found, form = eqx.partition(
            function(*eqx.combine(arrays, static)), eqx.is_array
        )
        return found

    mapped = jax.vmap(one, in_axes=axes)
    if len(devices) == 1:
        return eqx.combine(mapped(*arrays), form)
    # The last problem is repeated to fill all devices, which would wait otherwise.
    each = -(-batch // len(devices))
    # Problems are dealt out one by one, as neighbours take about as many steps.
    turn = np.arange(each * len(devices)).reshape(each, len(devices)).T.ravel()
    row = np.minimum(turn, batch - 1)
    fill = lambda tree, axis: tree if axis is None else jax.tree.map(_rows(row), tree)
    arrays = tuple(fill(a, axis) for a, axis in zip(arrays, axes, strict=True))
    part, whole = PartitionSpec(DEVICE_AXIS), PartitionSpec()
    specs = tuple(part if axis == 0 else whole for axis in axes)
    mesh = Mesh(np.array(devices), DEVICE_AXIS)
    spread = jax.shard_map(
        mapped,
        mesh=mesh,
        in_specs=specs,
        out_specs=part,
        check_vma=False,
    )
    found = jax.tree.map(_rows(np.argsort(turn)[:batch]), spread(*arrays))
    return eqx.combine(found, form)


def _rows(index):
    return lambda x: x[index]
