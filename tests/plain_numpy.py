"""Run JAX programs by NumPy, without a compiler.

To compile a program of physics takes seconds to minutes, so that thousands of models
could not be tried. What is traced is evaluated here, operation by operation, in float32
or in float64.
"""

import functools

import jax
import numpy as np
from jax.extend.core import Literal


def _reduce(function):
    return lambda x, *, axes, **_: function.reduce(x, axis=tuple(axes))


def _broadcast(x, *, shape, broadcast_dimensions, **_):
    middle = [1] * len(shape)
    for axis, size in zip(broadcast_dimensions, np.shape(x)):
        middle[axis] = size
    return np.broadcast_to(np.reshape(x, middle), shape)


def _slice(x, *, start_indices, limit_indices, strides):
    strides = strides or (1,) * len(start_indices)
    return x[tuple(map(slice, start_indices, limit_indices, strides))]


def _dynamic_slice(x, *starts, slice_sizes):
    starts = [
        min(max(int(i), 0), n - m) for i, n, m in zip(starts, x.shape, slice_sizes)
    ]
    return x[tuple(slice(i, i + m) for i, m in zip(starts, slice_sizes))]


def _dynamic_update_slice(x, update, *starts):
    starts = [
        min(max(int(i), 0), n - m) for i, n, m in zip(starts, x.shape, update.shape)
    ]
    x = np.array(x)
    x[tuple(slice(i, i + m) for i, m in zip(starts, update.shape))] = update
    return x


def _dot_general(a, b, *, dimension_numbers, **_):
    (contract_a, contract_b), (batch_a, batch_b) = dimension_numbers
    names = iter("abcdefghijklmnopqrstuvwxyz")
    of_a = [next(names) for _ in a.shape]
    of_b = [next(names) for _ in b.shape]
    for i, j in (*zip(contract_a, contract_b), *zip(batch_a, batch_b)):
        of_b[j] = of_a[i]
    out = [of_a[i] for i in batch_a]
    out += [x for i, x in enumerate(of_a) if i not in {*batch_a, *contract_a}]
    out += [x for i, x in enumerate(of_b) if i not in {*batch_b, *contract_b}]
    return np.einsum(f"{''.join(of_a)},{''.join(of_b)}->{''.join(out)}", a, b)


def _select(which, *cases):
    if len(cases) == 2:
        return np.where(which, cases[1], cases[0])
    return np.choose(which, cases)


def _pad(x, value, *, padding_config):
    low_high = [(low, high) for low, high, inner in padding_config]
    if any(inner for *_, inner in padding_config) or np.min(low_high, initial=0) < 0:
        return np.asarray(jax.lax.pad(x, np.asarray(value, x.dtype), padding_config))
    return np.pad(x, low_high, constant_values=value)


def _integer_pow(x, *, y):
    return x * x if y == 2 else x * x * x if y == 3 else np.power(1.0 * x, y)


_PRIMITIVES = {
    **{
        name: lambda *xs, function=function, **_: function(*xs)
        for name, function in {
            **{x: getattr(np, x) for x in ("sin", "cos", "tan", "exp", "log", "sqrt")},
            **{x: getattr(np, x) for x in ("sign", "floor", "ceil", "abs", "square")},
            **{"add": np.add, "add_any": np.add, "sub": np.subtract, "rem": np.fmod},
            **{"mul": np.multiply, "max": np.maximum, "min": np.minimum},
            **{"neg": np.negative, "pow": np.power, "is_finite": np.isfinite},
            **{"asin": np.arcsin, "acos": np.arccos, "atan2": np.arctan2},
            **{"tanh": np.tanh, "lt": np.less, "le": np.less_equal, "eq": np.equal},
            **{"gt": np.greater, "ge": np.greater_equal, "ne": np.not_equal},
            "rsqrt": lambda x: 1 / np.sqrt(x),
            "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
            "copy": lambda x: x,
            "stop_gradient": lambda x: x,
            "layout_constraint": lambda x: x,
        }.items()
    },
    "and": lambda a, b: a & b,
    "or": lambda a, b: a | b,
    "not": lambda a: ~np.asarray(a),
    "div": lambda a, b: (
        np.divide(a, b) if np.asarray(a).dtype.kind == "f" else np.fix(a / b)
    ),
    "select_n": _select,
    "integer_pow": _integer_pow,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda x, *, new_sizes, **_: np.reshape(x, new_sizes),
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, dimensions),
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "reduce_sum": _reduce(np.add),
    "reduce_prod": _reduce(np.multiply),
    "reduce_max": _reduce(np.maximum),
    "reduce_min": _reduce(np.minimum),
    "reduce_and": _reduce(np.logical_and),
    "reduce_or": _reduce(np.logical_or),
    "argmin": lambda x, *, axes, **_: np.argmin(x, axes[0]).astype(np.int32),
    "argmax": lambda x, *, axes, **_: np.argmax(x, axes[0]).astype(np.int32),
    "cumsum": lambda x, *, axis, reverse: (
        np.flip(np.cumsum(np.flip(x, axis), axis), axis)
        if reverse
        else np.cumsum(x, axis)
    ),
    "dot_general": _dot_general,
    "pad": _pad,
}


def _nested(eqn):
    """Return the program that an operation is a call of, or None."""
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        if name in eqn.params:
            return eqn.params[name]
    return None


class Program:
    """A traced function of arrays, to be evaluated in a floating-point type.

    The operations are made into a list of Python functions once, calls of functions
    among them, because to look at each again costs more than to compute it.
    """

    def __init__(self, function, *arguments):
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        self._closed, self._out = closed, jax.tree.structure(shape)
        self._compiled = {}

    def __call__(self, *arguments, dtype=np.float64):
        if dtype not in self._compiled:
            self._compiled[dtype] = _Compiled(self._closed, np.dtype(dtype))
        run = self._compiled[dtype]
        leaves = [run.cast(x) for x in jax.tree.leaves(arguments)]
        with np.errstate(all="ignore"):
            return jax.tree.unflatten(self._out, run(leaves))


class _Compiled:
    """A program as functions of numbered values."""

    def __init__(self, closed, dtype):
        self._dtype = dtype
        self._values, self._steps = [], []
        jaxpr = getattr(closed, "jaxpr", closed)
        self._inputs = [self._new() for _ in jaxpr.invars]
        self._outputs = self._inline(closed, self._inputs)

    def cast(self, x):
        x = np.asarray(x)
        return x.astype(self._dtype) if x.dtype.kind == "f" else x

    def __call__(self, arguments):
        values = self._values.copy()
        for i, x in zip(self._inputs, arguments):
            values[i] = x
        for function, inputs, output in self._steps:
            found = function(*[values[i] for i in inputs])
            if type(output) is int:
                values[output] = found
            else:
                for i, x in zip(output, found):
                    values[i] = x
        return [values[i] for i in self._outputs]

    def _new(self, value=None):
        self._values.append(value)
        return len(self._values) - 1

    def _inline(self, closed, inputs):
        """Add a program's operations, and return the numbers of its results."""
        jaxpr = getattr(closed, "jaxpr", closed)
        numbers = dict(zip(jaxpr.invars, inputs))
        for name, x in zip(jaxpr.constvars, getattr(closed, "consts", ())):
            numbers[name] = self._new(self.cast(x))

        def number(x):
            return self._new(self.cast(x.val)) if isinstance(x, Literal) else numbers[x]

        for eqn in jaxpr.eqns:
            given = [number(x) for x in eqn.invars]
            numbers.update(zip(eqn.outvars, self._add(eqn, given)))
        return [number(x) for x in jaxpr.outvars]

    def _add(self, eqn, given):
        name = eqn.primitive.name
        if name == "optimization_barrier":
            return given
        if name not in _PRIMITIVES and name not in _CONTROL and _nested(eqn):
            return self._inline(_nested(eqn), given)
        numbers = [self._new() for _ in eqn.outvars]
        function = self._function(eqn)
        alone = name in _PRIMITIVES or name in ("convert_element_type", "iota")
        self._steps.append((function, given, numbers[0] if alone else numbers))
        return numbers

    def _function(self, eqn):
        name, params = eqn.primitive.name, eqn.params
        if name in _CONTROL:
            return getattr(self, f"_{name}")(params)
        kind = self._kind(eqn.outvars[0].aval.dtype) if eqn.outvars else None
        if name == "convert_element_type":
            return lambda x: np.asarray(x, kind)
        if name == "iota":
            shape, axis = params["shape"], params["dimension"]
            middle = [1] * len(shape)
            middle[axis] = shape[axis]
            line = np.arange(shape[axis], dtype=kind).reshape(middle)
            line = np.broadcast_to(line, shape)
            return lambda: line
        if name in _PRIMITIVES:
            return functools.partial(_PRIMITIVES[name], **params)

        # Scatter, sort, decompositions: as JAX does them.
        types = [x.aval.dtype for x in eqn.invars]

        def of_jax(*arguments):
            given = [np.asarray(x, y) for x, y in zip(arguments, types)]
            found = eqn.primitive.bind(*given, **params)
            found = found if eqn.primitive.multiple_results else [found]
            return [self.cast(x) for x in found]

        return of_jax

    def _kind(self, dtype):
        return self._dtype if dtype.kind == "f" else dtype

    def _while(self, params):
        test, body = (
            _Compiled(params[x], self._dtype) for x in ("cond_jaxpr", "body_jaxpr")
        )
        split = np.cumsum([params["cond_nconsts"], params["body_nconsts"]])

        def run(*arguments):
            of_test, of_body = arguments[: split[0]], arguments[split[0] : split[1]]
            carry = arguments[split[1] :]
            while (goes_on := test([*of_test, *carry])[0]).any():
                following = body([*of_body, *carry])
                if goes_on.ndim:  # Each of a batch ends by itself.
                    following = [
                        np.where(goes_on.reshape(-1, *(1,) * (x.ndim - 1)), x, y)
                        for x, y in zip(following, carry)
                    ]
                carry = following
            return carry

        return run

    def _cond(self, params):
        branches = [_Compiled(x, self._dtype) for x in params["branches"]]

        def run(index, *arguments):
            return branches[min(max(int(index), 0), len(branches) - 1)](arguments)

        return run

    def _scan(self, params):
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        body = _Compiled(params["jaxpr"], self._dtype)
        order = range(params["length"])[:: -1 if params["reverse"] else 1]

        def run(*arguments):
            constants, carry, rows = (
                arguments[:first],
                arguments[first:last],
                arguments[last:],
            )
            outputs = []
            for i in order:
                found = body([*constants, *carry, *(x[i] for x in rows)])
                carry = found[: last - first]
                outputs.append(found[last - first :])
            outputs = outputs[:: -1 if params["reverse"] else 1]
            return [*carry, *(np.stack(x) for x in zip(*outputs))]

        return run


_CONTROL = ("while", "cond", "scan")
