"""ODE with the coupling as soft joints of its own, solved together with the contacts."""

from __future__ import annotations

from collections.abc import Mapping

from hapticbridge.pose import ZERO_VECTOR, Vector, add, rotation_between, scaled, subtract
from hapticbridge.study.engines import ode_native as native
from hapticbridge.study.engines.base import Engine, Setting
from hapticbridge.study.engines.held import Frame
from hapticbridge.study.engines.ode_engine import OdeEngine, OdeSimulation
from hapticbridge.study.engines.task import Task

# dParamLoStop, dParamHiStop, dParamCFM, dParamStopERP, dParamStopCFM and dParamERP
_LOW, _HIGH, _CFM, _STOP_ERP, _STOP_CFM, _ERP = 0, 1, 8, 9, 10, 13
_GROUP = 0x100
"""Between the parameters of an angular motor's axes."""


class OdeSpringEngine(OdeEngine):
    """ODE with an implicit coupling: a soft ball joint and a soft angular motor."""

    name = "ode_spring"
    settings: Mapping[str, Setting] = {
        **OdeEngine.settings,
        "coupling": Setting(
            "implicit spring: ball joint and angular motor, CFM 1/(T K + B)",
            "ODE Manual: Concepts, How To Use ERP and CFM",
        ),
    }

    def open(self, task: Task, timestep: float) -> OdeSimulation:
        """Sets a task up; see ``Engine.open``. It knows no convex meshes."""
        return OdeSpringSimulation(task, timestep)


class OdeSpringSimulation(OdeSimulation):
    """A task in ODE whose coupling is implicit in position and velocity.

    A joint with CFM 1/(T K + B) and ERP 1 whose target is y off pulls with

        λ = (T K + B)(y/T − v),    y = T (K (h_k − x_{k−1}) + B δh/T) / (T K + B)

    which is the coupling's f_k with x_k = x_{k−1} + T v: ODE's own spring, ERP = T K/(T K + B),
    whose damper acts against the moving handle.
    """

    def __init__(self, task: Task, timestep: float) -> None:
        super().__init__(task, timestep)
        self._ball = self._motor = 0
        coupling = task.coupling
        if coupling is None:
            return
        ode, body = self._ode, self._body
        self._ball = ode.dJointCreateBall(self._world, None)
        ode.dJointAttach(self._ball, body, None)
        ode.dJointSetBallAnchor(self._ball, *self._tool[0])
        softness = 1.0 / (timestep * coupling.stiffness + coupling.damping)
        ode.dJointSetBallParam(self._ball, _ERP, 1.0)
        ode.dJointSetBallParam(self._ball, _CFM, softness)
        hardness = timestep * coupling.rotational_stiffness + coupling.rotational_damping
        if hardness == 0:
            return
        self._motor = ode.dJointCreateAMotor(self._world, None)
        ode.dJointAttach(self._motor, body, None)
        ode.dJointSetAMotorNumAxes(self._motor, 3)
        for axis in range(3):
            ode.dJointSetAMotorAxis(self._motor, axis, 0, *(float(i == axis) for i in range(3)))
            for parameter, value in (
                (_HIGH, 0.0),
                (_LOW, 0.0),
                (_STOP_ERP, 1.0),
                (_STOP_CFM, 1.0 / hardness),
            ):
                ode.dJointSetAMotorParam(self._motor, axis * _GROUP + parameter, value)

    def _couple(self, handle: Frame) -> None:
        """Aims the joints at the handle, and steps."""
        if self._gains is not None:
            stiffness, damping, rotational_stiffness, rotational_damping = self._gains
            stretch = subtract(handle[0], self._tool[0])
            moved = subtract(handle[0], self._handle[0])
            offset = _offset(stiffness, damping, stretch, moved)
            self._ode.dJointSetBallAnchor2(self._ball, *add(self._tool[0], offset))
            if self._motor:
                twist = rotation_between(self._tool[1], handle[1])
                turned = rotation_between(self._handle[1], handle[1])
                angles = _offset(rotational_stiffness, rotational_damping, twist, turned)
                for axis, angle in enumerate(angles):
                    self._ode.dJointSetAMotorAngle(self._motor, axis, -angle)
        self.advance(ZERO_VECTOR, ZERO_VECTOR)


def _offset(stiffness: float, damping: float, stretch: Vector, moved: Vector) -> Vector:
    """Returns y for K, B/T, h_k − x_{k−1} and δh."""
    pull = add(scaled(stiffness, stretch), scaled(damping, moved))
    return scaled(1.0 / (stiffness + damping), pull)


def engines() -> tuple[Engine, ...]:
    """Returns the engines of this module.

    Raises:
        StudyError: ODE is not installed.
    """
    native.library()
    return (OdeSpringEngine(),)
