"""Kinematic trees joined to the tool."""

from __future__ import annotations

import mujoco


def reached_trees(model: mujoco.MjModel, tool: int, met: set[tuple[int, int]]) -> set[int]:
    """Returns the kinematic trees that can influence the tool's tree, including it.

    Contacts, equality constraints and tendons join trees. In a scene with flexes all trees count.
    ``met`` holds pairs of geom ids.
    """
    if model.nflex:  # contacts of a flex are not listed by geom
        return set(range(model.ntree))
    tree = model.body_treeid
    links = [{int(tree[model.geom_bodyid[geom]]) for geom in pair} for pair in met]
    links += [
        _trees_of_equality(model, equality)
        for equality in range(model.neq)
        if model.eq_active0[equality]
    ]
    links += [_trees_of_tendon(model, tendon) for tendon in range(model.ntendon)]
    links = [link - {-1} for link in links]
    reached = {tool}
    while new := {t for link in links if link & reached for t in link} - reached:
        reached |= new
    return reached


def _trees_of_equality(model: mujoco.MjModel, equality: int) -> set[int]:
    kind, objects = mujoco.mjtEq, (model.eq_obj1id[equality], model.eq_obj2id[equality])
    form, tree = int(model.eq_type[equality]), model.body_treeid
    ids = [int(each) for each in objects if each >= 0]
    if form == kind.mjEQ_JOINT:
        return {int(tree[model.jnt_bodyid[each]]) for each in ids}
    if form == kind.mjEQ_TENDON:
        return {t for each in ids for t in _trees_of_tendon(model, each)}
    if form not in (kind.mjEQ_CONNECT, kind.mjEQ_WELD):  # a flex has many bodies
        return set(range(model.ntree))
    if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        ids = [int(model.site_bodyid[each]) for each in ids]
    return {int(tree[each]) for each in ids}


def _trees_of_tendon(model: mujoco.MjModel, tendon: int) -> set[int]:
    wrap, tree = mujoco.mjtWrap, model.body_treeid
    bodies = {
        wrap.mjWRAP_JOINT: model.jnt_bodyid,
        wrap.mjWRAP_SITE: model.site_bodyid,
        wrap.mjWRAP_SPHERE: model.geom_bodyid,
        wrap.mjWRAP_CYLINDER: model.geom_bodyid,
    }
    start = int(model.tendon_adr[tendon])
    parts = range(start, start + int(model.tendon_num[tendon]))
    return {
        int(tree[bodies[kind][model.wrap_objid[part]]])
        for part in parts
        if (kind := mujoco.mjtWrap(int(model.wrap_type[part]))) in bodies
    }
