"""Small MJCF scenes behind the compiled tick, and SciPy's view of what was recorded.

``live`` steps through MuJoCo's Python bindings as the bridge does, ``fast`` through its C symbols
as the audit does. The device's pose is the handle's, relative to the grip's at the start, unless a
test chooses otherwise.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticbridge.coupling import Coupling
from hapticbridge.demand.methods import IMPLICIT, prepare
from hapticbridge.kernel.codes import OK
from hapticbridge.kernel.parameters import RunParameters
from hapticbridge.kernel.record import SAMPLE_DTYPE, TICK_DTYPE
from hapticbridge.kernel.state import BoundKernel
from hapticbridge.kernel.tick import after_step, before_step, simulate
from hapticbridge.run.summary import Ledger
from hapticbridge.scene import Scene, load_scene
from hapticbridge.scene.scene import has_rigid_contact

Array: TypeAlias = NDArray[np.float64]
OnTick: TypeAlias = Callable[[int, Any], None]

T = 1e-3
DEFAULT = Coupling(2400.0, 0.5, 2.4, 5e-4)
IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def mjcf(worldbody: str, rest: str = "", option: str = 'gravity="0 0 0"') -> str:
    """Returns a scene in radians without contact unless a geom asks for it."""
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option {option} cone="elliptic"/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody>{worldbody}</worldbody>
      {rest}
    </mujoco>"""


FREE_BALL = mjcf("""
    <body name="tool"><freejoint/>
      <geom type="sphere" size="0.015" mass="0.1"/>
      <site name="grip"/>
    </body>""")


def load(xml: str, grip: str = "grip") -> Scene:
    """Loads a scene from text, as a user's file would be."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.xml"
        path.write_text(xml, encoding="utf-8")
        return load_scene(path, grip=grip)


def samples_of(positions: Array, rotations: Rotation | None = None) -> NDArray[np.void]:
    """Returns device samples at these positions (n, 3) and orientations (none: unturned)."""
    samples = np.zeros(len(positions), SAMPLE_DTYPE)
    samples["position"] = positions
    samples["quaternion"][:, 0] = 1.0
    if rotations is not None:
        samples["quaternion"] = rotations.as_quat(scalar_first=True)
    return samples


def at_rest(count: int) -> NDArray[np.void]:
    """Returns samples of a device that does not move."""
    return samples_of(np.zeros((count, 3)))


def sines(count: int, amplitude: float = 0.01, frequency: float = 2.0, period: float = T) -> Array:
    """Returns a smooth curve (n, 3) in m that starts at 0, with another frequency per axis."""
    time = period * np.arange(1, count + 1)[:, None]
    factors = np.array([1.0, 1.3, 0.7])
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * factors * time))


@dataclass
class Run:
    """A run and where it started; row k of ``ticks`` is tick k."""

    scene: Scene
    parameters: RunParameters
    binding: BoundKernel
    ticks: NDArray[np.void]
    tool_start: Array
    handle_start: Array
    start_energy: float

    @property
    def ledger(self) -> Ledger:
        return Ledger.from_state(self.binding.state)

    def tool_steps(self) -> Array:
        return np.diff(self.ticks["tool_position"], axis=0, prepend=self.tool_start[None, :3])

    def handle_steps(self) -> Array:
        return np.diff(self.ticks["handle_position"], axis=0, prepend=self.handle_start[None, :3])

    def tool_turns(self) -> Array:
        return turns(self.ticks["tool_quaternion"], self.tool_start[3:])

    def handle_turns(self) -> Array:
        return turns(self.ticks["handle_quaternion"], self.handle_start[3:])

    def stored(self) -> Array:
        """Storage after each tick minus that at the start."""
        return np.asarray(self.ticks["kinetic"] + self.ticks["potential"] - self.start_energy)


def rotation(quaternions: Array) -> Rotation:
    return Rotation.from_quat(quaternions, scalar_first=True)


def turns(quaternions: Array, start: Array) -> Array:
    """Returns the rotation vectors log(R_k R_{k-1}^T) by SciPy."""
    before = np.concatenate([start[None], quaternions[:-1]])
    return np.asarray((rotation(quaternions) * rotation(before).inv()).as_rotvec())


PLAIN = RunParameters(
    grip="grip",
    period=T,
    substeps=1,
    coupling=DEFAULT,
    force_limit=1e9,
    torque_limit=1e9,
    ramp_ticks=0,
    device_origin=IDENTITY,
    handle_origin=IDENTITY,
    device_start=IDENTITY,
)
"""Parameters of a run without force limits or ramp."""


def unlimited(
    scene: Scene,
    coupling: Coupling,
    period: float = T,
    substeps: int = 1,
    device_start: tuple[float, ...] = IDENTITY,
    **changes: Any,
) -> RunParameters:
    """Returns the parameters of a run from where the scene stands, without force limits or ramp."""
    own: dict[str, Any] = {
        "grip": scene.grip,
        "period": period,
        "substeps": substeps,
        "coupling": coupling,
        "device_origin": device_start,
        "handle_origin": scene.grip_pose(),
        "device_start": device_start,
        "is_rigid": has_rigid_contact(scene.model),
    }
    return replace(PLAIN, **(own | changes))


def bind(
    scene: Scene,
    coupling: Coupling = DEFAULT,
    *,
    period: float = T,
    substeps: int = 1,
    contact: str = "rigid",
    device_start: tuple[float, ...] = IDENTITY,
    **changes: Any,
) -> tuple[BoundKernel, RunParameters]:
    """Prepares a scene for ``implicit`` and binds the kernel to it, without force limits."""
    prepare(scene, coupling, period, substeps, IMPLICIT.with_contact(contact))
    parameters = unlimited(scene, coupling, period, substeps, device_start, **changes)
    return BoundKernel(scene.model, scene.data, parameters), parameters


def run_of(scene: Scene, binding: BoundKernel, parameters: RunParameters) -> Run:
    """Returns a run without ticks: call it before the first one."""
    pose = binding.state["pose"][0]
    return Run(
        scene,
        parameters,
        binding,
        np.zeros(0, TICK_DTYPE),
        np.concatenate([pose["tool_position"], pose["tool_quaternion"]]),
        np.concatenate([pose["handle_position"], pose["handle_quaternion"]]),
        float(binding.state["energy"]["start_energy"][0]),
    )


def go_on(
    run: Run,
    samples: NDArray[np.void],
    on_tick: OnTick | None = None,
    after_tick: OnTick | None = None,
) -> Run:
    """Adds ticks to a run through MuJoCo's bindings; the callbacks get (tick, data)."""
    model, data = run.scene.model, run.scene.data
    state, row, step = run.binding.state, run.binding.row, run.binding.step
    rows = np.zeros(len(samples), TICK_DTYPE)
    for k in range(len(samples)):
        if on_tick is not None:
            on_tick(k, data)
        for substep in range(run.parameters.substeps):
            assert before_step(state, samples[k : k + 1], row, substep, T) == OK
            step(model, data)
            assert after_step(state, row, substep) == OK
        rows[k] = row[0]
        if after_tick is not None:
            after_tick(k, data)
    run.ticks = np.concatenate([run.ticks, rows])
    return run


def live(
    scene: Scene | str,
    samples: NDArray[np.void],
    coupling: Coupling = DEFAULT,
    *,
    on_tick: OnTick | None = None,
    after_tick: OnTick | None = None,
    **changes: Any,
) -> Run:
    """Runs tick by tick, as the bridge does."""
    scene = load(scene) if isinstance(scene, str) else scene
    binding, parameters = bind(scene, coupling, **changes)
    return go_on(run_of(scene, binding, parameters), samples, on_tick, after_tick)


def fast(
    scene: Scene | str, samples: NDArray[np.void], coupling: Coupling = DEFAULT, **changes: Any
) -> Run:
    """Runs all ticks inside the compiled kernel, as the audit does."""
    scene = load(scene) if isinstance(scene, str) else scene
    binding, parameters = bind(scene, coupling, **changes)
    run = run_of(scene, binding, parameters)
    run.ticks = np.zeros(len(samples), TICK_DTYPE)
    assert simulate(binding.state, samples, binding.row, run.ticks) == len(samples)
    return run


def wrench_law(run: Run) -> Array:
    """Returns the coupling law (n, 6) at the recorded poses, by NumPy and SciPy."""
    coupling, period, ticks = run.parameters.coupling, run.parameters.period, run.ticks
    force = coupling.stiffness * (ticks["handle_position"] - ticks["tool_position"])
    force = force + coupling.damping / period * (run.handle_steps() - run.tool_steps())
    twist = rotation(ticks["handle_quaternion"]) * rotation(ticks["tool_quaternion"]).inv()
    torque = coupling.rotational_stiffness * twist.as_rotvec()
    torque = torque + coupling.rotational_damping / period * (run.handle_turns() - run.tool_turns())
    return np.concatenate([force, torque], axis=1)


def coupling_work(run: Run) -> Array:
    """Returns the coupling's work per tick (n,), from recorded wrenches and poses."""
    wrench = run.ticks["wrench_on_tool"]
    steps = np.concatenate([run.tool_steps(), run.tool_turns()], axis=1)
    return np.asarray(np.sum(wrench * steps, axis=1))


def slack(run: Run) -> Array:
    """Returns the cumulative slack (n,) of the coupling along the recorded tool motion."""
    coupling, period = run.parameters.coupling, run.parameters.period
    linear = coupling.stiffness + coupling.damping / period
    angular = coupling.rotational_stiffness + coupling.rotational_damping / period
    moved, turned = run.tool_steps(), run.tool_turns()
    return np.cumsum(
        0.5 * linear * np.sum(moved**2, axis=1) + 0.5 * angular * np.sum(turned**2, axis=1)
    )
