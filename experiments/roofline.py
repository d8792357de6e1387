"""How near physics comes to what a core can do: ``python -m experiments roofline``.

The floating-point operations of one step are counted by evaluating the traced step one
operation at a time, with its loops as long as they really are: as the slowest
environment of a tile needs, with the lanes that fill a tile up. Sums, products,
quotients, minima, roots and other functions count once for each number that they
compute; comparisons, choices and copies do not count. What the core can do is measured
by a product of two matrices.

To measure one CPU core, start it with ``taskset -c 0``.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend import core

from experiments import benchmark, measured
from experiments.search import TASKS
from gasil_jax.errors import InputError
from gasil_jax.host import command_line

#: Primitives that compute one number for each number of their result.
_BY_NUMBER = frozenset(
    "abs acos add add_any asin atan2 clamp cos div exp integer_pow log max min mul neg "
    "pow rsqrt sign sin sqrt square sub tan tanh".split()
)
#: Primitives that compute one number for each number of their operand.
_BY_OPERAND = frozenset("cumsum reduce_max reduce_min reduce_prod reduce_sum".split())
_MATRIX = 1024


@dataclasses.dataclass(frozen=True)
class Options:
    """Compare the arithmetic of physics with what a core can do.

    Attributes:
      envs: names of the tasks.
      num_envs: number of environments.
      repeats: number of times that each task is timed.
      page: write the table into docs/performance.md too, below the same command.
    """

    envs: tuple[str, ...] = ("walker2d",)
    num_envs: int = 32
    repeats: int = 5
    page: bool = False


def count_operations(function: Callable[..., Any], *arguments: Any) -> int:
    """Return the number of floating-point operations of a call of a function."""
    traced = jax.make_jaxpr(function)(*arguments)
    return evaluate(traced, *jax.tree.leaves(arguments))[0]


def evaluate(traced: core.ClosedJaxpr, *inputs: Any) -> tuple[int, list[Any]]:
    """Evaluate a traced function; return its number of operations and its results."""
    total = 0
    values = dict(zip(traced.jaxpr.constvars, traced.consts, strict=True))
    values |= dict(zip(traced.jaxpr.invars, inputs, strict=True))

    def read(x: Any) -> Any:
        return x.val if isinstance(x, core.Literal) else values[x]

    for equation in traced.jaxpr.eqns:
        operands = [read(x) for x in equation.invars]
        count, results = _evaluate(equation, operands)
        total += count
        values |= dict(zip(equation.outvars, results, strict=True))
    return total, [read(x) for x in traced.jaxpr.outvars]


def _evaluate(equation: Any, operands: list[Any]) -> tuple[int, list[Any]]:
    """Return the number of operations of one primitive, and its results."""
    name, params = equation.primitive.name, equation.params
    if name == "scan":
        return _scan(params, operands)
    if name == "while":
        return _while(params, operands)
    if name == "cond":
        index, *operands = operands
        return evaluate(params["branches"][int(index)], *operands)
    for inner in ("jaxpr", "call_jaxpr", "call"):
        if inner in params:
            return evaluate(params[inner], *operands)
    results = equation.primitive.bind(*operands, **params)
    results = list(results) if equation.primitive.multiple_results else [results]
    return _operations(name, params, operands, results), results


def _operations(name: str, params: Any, operands: Any, results: Any) -> int:
    """Return the number of floating-point operations of one simple primitive."""
    if name in _BY_NUMBER:
        size = results[0].size
    elif name in _BY_OPERAND:
        size = operands[0].size
    elif name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        terms = math.prod(operands[0].shape[i] for i in contracted)
        size = 2 * terms * results[0].size
    else:
        return 0
    return size if jnp.issubdtype(results[0].dtype, jnp.floating) else 0


def _scan(params: dict[str, Any], operands: list[Any]) -> tuple[int, list[Any]]:
    constant, carried = params["num_consts"], params["num_carry"]
    consts, carry = operands[:constant], operands[constant : constant + carried]
    rows, total, order = operands[constant + carried :], 0, range(params["length"])
    outputs: dict[int, list[Any]] = {}
    for i in reversed(order) if params["reverse"] else order:
        row = [x[i] for x in rows]
        count, results = evaluate(params["jaxpr"], *consts, *carry, *row)
        total, carry, outputs[i] = total + count, results[:carried], results[carried:]
    stacked = [jnp.stack(x) for x in zip(*(outputs[i] for i in order), strict=True)]
    return total, [*carry, *stacked]


def _while(params: dict[str, Any], operands: list[Any]) -> tuple[int, list[Any]]:
    of_condition = params["cond_nconsts"]
    of_body = of_condition + params["body_nconsts"]
    carry, total = operands[of_body:], 0
    while True:
        count, (goes_on,) = evaluate(
            params["cond_jaxpr"], *operands[:of_condition], *carry
        )
        total += count
        if not goes_on:
            return total, carry
        count, carry = evaluate(
            params["body_jaxpr"], *operands[of_condition:of_body], *carry
        )
        total += count


def product_row(env_name: str) -> benchmark.Row:
    """Floating-point operations per second of a product of two matrices."""
    x = jnp.ones((_MATRIX, _MATRIX))
    product = jax.jit(jnp.matmul)
    jax.block_until_ready(product(x, x))
    call = functools.partial(product, x, x)
    run = functools.partial(benchmark.speed_of, call, 2 * _MATRIX**3)
    return benchmark.Row(env_name, "operations of a matrix product", 1, run)


def physics_row(env_name: str, num_envs: int) -> tuple[benchmark.Row, float, float]:
    """Floating-point operations per second of physics.

    Returns:
      The row, the operations of a step of one environment, and the bytes of its state
      that are read and written.
    """
    row = benchmark.physics_row(env_name, "ours", num_envs)
    step = functools.partial(benchmark.random_step, benchmark.make(env_name, "ours"))
    count = count_operations(step, row.states, jax.random.key(0)) / num_envs
    size = 2 * sum(x.nbytes for x in jax.tree.leaves(row.states)) / num_envs
    name, run = "operations of physics", lambda: count * row.run()
    return dataclasses.replace(row, name=name, run=run), count, size


def run(options: Options) -> None:
    """Print the table."""
    if others := set(options.envs) - set(TASKS):
        raise InputError(f"envs has {min(others)!r}: allowed {', '.join(TASKS)}")
    command_line.check_minimum(options, num_envs=1, repeats=1)
    if options.page:
        measured.find("roofline", options)
    benchmark.start_jax(1)
    rows = []
    for name in options.envs:
        product = product_row(name)
        physics, count, size = physics_row(name, options.num_envs)
        # In turn, so that the share compares speeds from the same minutes.
        benchmark.measure([product, physics], options.repeats)
        cells = (count / 1e3, count / size, physics.speed / count / 1e3)
        speeds = (physics.speed / 1e9, product.speed / 1e9)
        rows.append([name, *(f"{x:,.1f}" for x in (*cells, *speeds))])
        rows[-1].append(f"{physics.speed / product.speed:.2f}")
        print(", ".join(rows[-1]), flush=True)
    if options.page:
        head = ["", "thousand operations a step", "operations a byte of state"]
        head += ["thousand steps/s", "GFLOP/s", "of a matrix product", "share"]
        measured.write("roofline", options, head, rows)
