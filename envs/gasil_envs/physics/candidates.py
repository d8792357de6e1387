"""Which geoms may touch, and with which parameters: MuJoCo's rules, from the model.

See https://mujoco.readthedocs.io/en/stable/computation/index.html#collision.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


class Candidates(NamedTuple):
    """Pairs of geoms that may touch, P of them."""

    geoms: np.ndarray  # (P, 2), the one whose type has the lower number first.
    dim: np.ndarray  # (P,), number of dimensions of the contact's force, condim.
    margin: np.ndarray  # (P,), distance in metres from which a contact is in play.
    #: (P, 5), of two tangents, of turning about the normal and about them.
    friction: np.ndarray
    solref: np.ndarray  # (P, 2).
    solimp: np.ndarray  # (P, 5).


def candidates(model: mujoco.MjModel) -> Candidates:
    """Return all pairs, in MJX's order: by condim, then types, as these first occur."""
    flags = mujoco.mjtDisableBit
    none = model.opt.disableflags & (flags.mjDSBL_CONSTRAINT | flags.mjDSBL_CONTACT)
    rows = [] if none else _that_may_touch(model, list(_pairs(model)))
    parameters = [_parameters(model, *row) for row in rows]
    kinds = [
        (x[0], *model.geom_type[[g1, g2]])
        for (g1, g2, _), x in zip(rows, parameters, strict=True)
    ]
    first = {kind: i for i, kind in reversed(list(enumerate(kinds)))}
    order = sorted(range(len(rows)), key=lambda i: (kinds[i][0], first[kinds[i]], i))
    shapes = ((), (), (5,), (2,), (5,))
    geoms = np.array([rows[i][:2] for i in order], int).reshape(-1, 2)
    columns = [
        np.array([parameters[i][k] for i in order]).reshape(-1, *shape)
        for k, shape in enumerate(shapes)
    ]
    return Candidates(geoms, columns[0].astype(int), *columns[1:])


def _pairs(model: mujoco.MjModel) -> Iterator[tuple[int, int, int]]:
    """Yield the geoms of each pair, and its number in <pair> or -1."""
    seen = set()
    # Neither of two bodies moves, if they are parts of the world or held by mocap.
    is_held = model.body_treeid < 0
    for i in range(model.npair):
        bodies = model.geom_bodyid[[model.pair_geom1[i], model.pair_geom2[i]]]
        if is_held[bodies].all():
            continue
        pair = _in_order(model, int(model.pair_geom1[i]), int(model.pair_geom2[i]))
        seen.add(pair)
        yield (*pair, i)
    excluded = set(model.exclude_signature)
    parent = model.body_weldid[model.body_parentid[model.body_weldid]]
    parents_collide = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    geoms_of = [
        np.flatnonzero(
            (model.geom_bodyid == body)
            & ((model.geom_contype | model.geom_conaffinity) > 0)
        )
        for body in range(model.nbody)
    ]
    for a, b in itertools.combinations(range(model.nbody), 2):
        weld_a, weld_b = model.body_weldid[[a, b]]
        if weld_a == weld_b or (a << 16) + b in excluded or is_held[[a, b]].all():
            continue
        is_parent = weld_a == parent[b] or weld_b == parent[a]
        if is_parent and weld_a and weld_b and not parents_collide:
            continue
        for g1, g2 in itertools.product(geoms_of[a].tolist(), geoms_of[b].tolist()):
            g1, g2 = pair = _in_order(model, g1, g2)
            mask = (model.geom_contype[g1] & model.geom_conaffinity[g2]) | (
                model.geom_contype[g2] & model.geom_conaffinity[g1]
            )
            if mask and pair not in seen and model.geom_type[g2] != _PLANE:
                seen.add(pair)
                yield (*pair, -1)


def _that_may_touch(
    model: mujoco.MjModel, rows: list[tuple[int, int, int]]
) -> list[tuple[int, int, int]]:
    """Leave out solids whose middles are equally far apart in any state, and too far.

    The round hubs of two hinges are such a pair.
    """
    geoms = np.array([row[:2] for row in rows], int).reshape(-1, 2)
    solid = model.geom_type[geoms].min(axis=1) > int(mujoco.mjtGeom.mjGEOM_CAPSULE)
    if not solid.any():
        return rows
    data, rng, apart = mujoco.MjData(model), np.random.default_rng(0), []
    for _ in range(3):
        data.qpos[:] = model.qpos0 + rng.normal(size=model.nq)
        mujoco.mj_kinematics(model, data)
        apart.append(
            np.linalg.norm(np.diff(data.geom_xpos[geoms], axis=1)[:, 0], axis=1)
        )
    reach = (model.geom_rbound + model.geom_margin)[geoms].sum(axis=1)
    never = solid & (np.ptp(apart, axis=0) < 1e-9) & (apart[0] > reach)
    return [row for row, x in zip(rows, never, strict=True) if not (x and row[2] < 0)]


def _in_order(model: mujoco.MjModel, a: int, b: int) -> tuple[int, int]:
    return (b, a) if model.geom_type[a] > model.geom_type[b] else (a, b)


def _parameters(model: mujoco.MjModel, a: int, b: int, pair: int) -> tuple[Any, ...]:
    """Return dim, margin, friction, solref and solimp of a pair."""
    if pair >= 0:
        friction = np.maximum(model.pair_friction[pair], mujoco.mjMINMU)
        return (
            model.pair_dim[pair],
            model.pair_margin[pair],
            friction,
            model.pair_solref[pair],
            model.pair_solimp[pair],
        )
    margin = model.geom_margin[a] + model.geom_margin[b]
    priority = model.geom_priority[[a, b]]
    if priority[0] != priority[1]:
        one = (a, b)[int(np.argmax(priority))]
        dim, friction = model.geom_condim[one], model.geom_friction[one]
        solref, solimp = model.geom_solref[one], model.geom_solimp[one]
    else:
        dim = max(model.geom_condim[a], model.geom_condim[b])
        friction = np.maximum(model.geom_friction[a], model.geom_friction[b])
        share = model.geom_solmix[[a, b]]
        if (share < mujoco.mjMINVAL).all():
            share = np.ones(2)
        share = np.where(share < mujoco.mjMINVAL, 0.0, share)
        share = share / share.sum()
        solref = np.minimum(model.geom_solref[a], model.geom_solref[b])
        if model.geom_solref[a][0] > 0 and model.geom_solref[b][0] > 0:
            solref = share @ model.geom_solref[[a, b]]
        solimp = share @ model.geom_solimp[[a, b]]
    friction = np.maximum(friction, mujoco.mjMINMU)[[0, 0, 1, 2, 2]]
    return dim, margin, friction, solref, solimp
