"""Run JAX programs by NumPy, without a compiler.

To compile a program of physics takes seconds to minutes, so that thousands of models
could not be tried. What is traced is evaluated here, operation by operation, in float32
or in float64.
"""

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
        raise KeyError
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
    """Return the program that an operation is a call of."""
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        if name in eqn.params:
            return eqn.params[name]
    return None


class Program:
    """A traced function of arrays, to be evaluated in a floating-point type."""

    def __init__(self, function, *arguments):
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        self._closed, self._out = closed, jax.tree.structure(shape)
        # By program and type; a program is kept, so that no other has its identity.
        self._constants, self._keep = {}, []

    def __call__(self, *arguments, dtype=np.float64):
        self._dtype = dtype
        leaves = [self._cast(x) for x in jax.tree.leaves(arguments)]
        with np.errstate(all="ignore"):
            return jax.tree.unflatten(self._out, self._run(self._closed, leaves))

    def _cast(self, x):
        x = np.asarray(x)
        return x.astype(self._dtype) if x.dtype.kind == "f" else x

    def _run(self, closed, arguments):
        jaxpr = getattr(closed, "jaxpr", closed)
        if (id(jaxpr), self._dtype) not in self._constants:
            self._keep.append(jaxpr)
            constants = dict(zip(jaxpr.constvars, getattr(closed, "consts", ())))
            atoms = [x for eqn in jaxpr.eqns for x in eqn.invars]
            for x in (*atoms, *jaxpr.outvars):
                if isinstance(x, Literal):
                    constants[id(x)] = x.val
            self._constants[id(jaxpr), self._dtype] = {
                name: self._cast(x) for name, x in constants.items()
            }
        values = dict(self._constants[id(jaxpr), self._dtype])
        values.update(zip(jaxpr.invars, arguments))

        def read(x):
            return values[id(x) if isinstance(x, Literal) else x]

        for eqn in jaxpr.eqns:
            results = self._apply(eqn, [read(x) for x in eqn.invars])
            values.update(zip(eqn.outvars, results))
        return [read(x) for x in jaxpr.outvars]

    def _apply(self, eqn, arguments):
        name, params = eqn.primitive.name, eqn.params
        if name == "while":
            return self._while(params, arguments)
        if name == "scan":
            return self._scan(params, arguments)
        if name == "cond":
            index = min(max(int(arguments[0]), 0), len(params["branches"]) - 1)
            return self._run(params["branches"][index], arguments[1:])
        if name == "optimization_barrier":
            return arguments
        if name == "convert_element_type":
            kind = np.dtype(params["new_dtype"])
            return [np.asarray(arguments[0], self._dtype if kind.kind == "f" else kind)]
        if name == "iota":
            shape, axis = params["shape"], params["dimension"]
            kind = np.dtype(params["dtype"])
            line = np.arange(
                shape[axis], dtype=self._dtype if kind.kind == "f" else kind
            )
            middle = [1] * len(shape)
            middle[axis] = shape[axis]
            return [np.broadcast_to(line.reshape(middle), shape)]
        if name in _PRIMITIVES:
            try:
                return [np.asarray(_PRIMITIVES[name](*arguments, **params))]
            except KeyError:
                pass
        elif _nested(eqn) is not None:
            nested = _nested(eqn)
            return self._run(nested, arguments)
        # Gather, scatter, sort, decompositions: as JAX does them.
        given = [np.asarray(x, y.aval.dtype) for x, y in zip(arguments, eqn.invars)]
        found = eqn.primitive.bind(*given, **params)
        found = found if eqn.primitive.multiple_results else [found]
        return [self._cast(x) for x in found]

    def _while(self, params, arguments):
        split = np.cumsum([params["cond_nconsts"], params["body_nconsts"]])
        of_test, of_body, carry = (
            arguments[: split[0]],
            arguments[split[0] : split[1]],
            arguments[split[1] :],
        )
        while self._run(params["cond_jaxpr"], [*of_test, *carry])[0]:
            carry = self._run(params["body_jaxpr"], [*of_body, *carry])
        return carry

    def _scan(self, params, arguments):
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        constants, carry, rows = (
            arguments[:first],
            arguments[first:last],
            arguments[last:],
        )
        outputs = []
        order = range(params["length"])
        for i in reversed(order) if params["reverse"] else order:
            found = self._run(
                params["jaxpr"], [*constants, *carry, *(x[i] for x in rows)]
            )
            carry = found[: params["num_carry"]]
            outputs.append(found[params["num_carry"] :])
        outputs = outputs[::-1] if params["reverse"] else outputs
        return [*carry, *(np.stack(x) for x in zip(*outputs))]
