"""The settings that every engine tells: complete, sourced, and what it is really given.

The libraries need not be installed: their names are stood in for by mocks, which note every call.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib import metadata as metadata_module
from unittest.mock import MagicMock

import pytest
from engine_tasks import FLOOR, GRAVITY, RESTING

from hapticbridge.lab.engines.base import ENGINES, Body, Pose, Task

PACKAGE = "hapticbridge.lab.engines."
LIBRARIES = ("pybullet", "sapien")
SHAPE, HEIGHT = RESTING["box"]
TASK = Task(
    "rest",
    Body(0.1, (2e-5, 2.5e-5, 3e-5), shapes=(SHAPE,), friction=0.25),
    (FLOOR,),
    (0.0, 0.0, -GRAVITY),
    start=Pose((0.0, 0.0, HEIGHT)),
)


@pytest.fixture
def libraries(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, MagicMock]]:
    """Stands in for every library, and lets the engines' modules be imported anew with them."""
    mocks = {name: MagicMock(name=name) for name in LIBRARIES}
    for name, mock in mocks.items():
        monkeypatch.setitem(sys.modules, name, mock)
    pybullet = mocks["pybullet"]
    pybullet.CONSTRAINT_SOLVER_LCP_SI, pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG = 1, 3
    pybullet.connect.return_value = 0
    monkeypatch.setattr(metadata_module, "version", lambda name: f"{name} 0")
    kept = {PACKAGE + name: sys.modules.get(PACKAGE + name) for name in set(ENGINES.values())}
    for name in kept:
        sys.modules.pop(name, None)
    yield mocks
    for name, module in kept.items():
        sys.modules.pop(name, None)
        if module is not None:
            sys.modules[name] = module


def test_pybullet_is_given_what_it_tells_and_nothing_else(libraries: dict[str, MagicMock]) -> None:
    library = libraries["pybullet"]
    library.getBasePositionAndOrientation.return_value = ((0.0,) * 3, (0.0, 0.0, 0.0, 1.0))
    for engine in import_module(PACKAGE + "bullet").engines():
        library.setPhysicsEngineParameter.reset_mock()
        engine.open(TASK, 1e-3).close()
        given = dict(library.setPhysicsEngineParameter.call_args.kwargs)
        assert given.pop("fixedTimeStep") == 1e-3
        assert isinstance(given.pop("constraintSolverType"), int)
        given.pop("physicsClientId")
        told = {key: setting.value.split()[0] for key, setting in engine.settings.items()}
        assert given
        assert {key: f"{value:g}" for key, value in given.items()}.items() <= told.items()
        dynamics = library.changeDynamics.call_args_list
        assert all(call.kwargs["linearDamping"] == 0 for call in dynamics)
        # Bullet multiplies the coefficients of the two bodies
        product = math.prod(call.kwargs["lateralFriction"] for call in dynamics[-2:])
        assert product == pytest.approx(0.25)


def test_physx_is_given_what_it_tells(libraries: dict[str, MagicMock]) -> None:
    physx = libraries["sapien"].physx
    pose = MagicMock()
    pose.p.tolist.return_value, pose.q.tolist.return_value = [0.0] * 3, [1.0, 0.0, 0.0, 0.0]
    physx.PhysxRigidDynamicComponent.return_value.entity_pose = pose
    module = import_module(PACKAGE + "physx")
    engine = module.engines()[0]
    for _ in range(2):
        engine.open(TASK, 1e-3)
    # once in a process, or the second would take the tolerances of the first away
    physx.PhysxEngine.assert_called_once_with(module.LENGTH, module.SPEED)
    told = engine.settings["tolerances"].value
    assert told == f"length {module.LENGTH:g} m (default 1), speed {module.SPEED:g} m/s"
    shape = physx.set_shape_config.call_args.kwargs
    assert engine.settings["contact offset"].value == f"{shape['contact_offset']:g} m"
    assert engine.settings["rest offset"].value == f"{shape['rest_offset']:g}"
    body = physx.set_body_config.call_args.kwargs
    iterations = str(body["solver_position_iterations"])
    assert engine.settings["position iterations"].value == iterations
    assert engine.settings["sleep threshold"].value == f"{body['sleep_threshold']:g}"
    scene = physx.set_scene_config.call_args.args[0]
    assert scene.enable_tgs is scene.enable_pcm is scene.enable_friction_every_iteration is True
