"""A scene slower than the loop: the coupling pulls at a pose of the tool that is shown in between.

The scene runs in its own loop, one step per n ticks: T_s = n T. Each step uses the handle pose from
the moment when the previous result was collected. When the next result arrives, it is older than
the handle by T_s or more. The loop shows the tool where it is by now,

    y* = x + v q + ½ a q²,    q = t − t_h

with x the newest pose of the scene, v its velocity in m/s, a the change of v over the last steps in
m/s², t_h the time of the handle that it answers. Rotations have rotation vectors. A surface that
the tool touches or is near to stops it: a plane through the contact point of the newest step, which
moves on as fast as the tool has pushed it.

The coupling between handle h and shown pose y gives the tool, when y moves by δy in one tick,

    P = V(h − y_{k−1}) − V(h − y_k) + f_d·δy

in J. V is the energy of its spring with its force level, f_d = P_F(K e + (B'/T)(δh − δy)) −
P_F(K e) what its damper adds. Under b >= K T/2 + B', with the fast T, the hand has then put in at
least Σ P + V, for every motion of y: ‖f_d‖² <= (B'/T) f_d·(δh − δy), so what the damper adds is a
sum of squares. The scene took W = Σ f_s·δx, metered in its own loop. The tank

    D = Σ P − W

is what the hand has given and the scene has not yet got. It is another tank than that of
``rigid_contact``, which holds what the environment has dissipated. The tool is shown at the pose
nearest to y*, on the way there, with which D does not become negative (passive set-position
modulation, Lee & Huang 2010), so the hand gets nothing that the scene did not give. D is capped, so
that an hour of dissipation does not pay for one push. The cap holds from the tick after a result
on, and of another program in every tick.

A result may have taken more than the hand has given by now, W > Σ P, because the hand turned back
meanwhile. D is then negative: a loan to the scene, −D. Until the scene or the hand has paid it, the
tool is shown only where that costs nothing, P >= 0. So Σ P >= min W over the time until now, and
the hand cannot get more than the scene has released. The next handle that the scene is given is
drawn so near to its tool that the springs hold no more than the credit + D. The credit is what they
hold at the force level, F²/2K + F_r²/2K_r, at the present gains.

A device that answers late holds the force from before a jump of y for longer. What its condition
counts on is ½ K ‖δh − δy‖² in each tick (``theory.bounds.minimum_damping``), of which the above
leaves ½ K ‖δh‖². So behind a delay the coupling gives what it gives to any scene, f·δy, which V, of
e along lines, always releases. A twist φ is no such length. If the tool turns across it, V_r falls
by less, and the torque's change Δτ is larger than K_r δφ. So for rotation

    P_r = min(τ·δφ, V_r before − V_r after − ‖Δτ‖²/2K_r + τ_d·δφ)

in J, with Δτ the change of K_r φ at its level while the tool turns, in N m, and τ_d what the damper
adds. With a torque that is d ticks late the hand gets Δτ·δφ_h, at most ‖Δτ‖²/2K_r + ½ K_r ‖δφ_h‖²,
for each of d turns of the tool, on any way: the first is in P_r, b_r pays the second, as along
lines. What the handle's own turns change is in ``law.slip``. That needs the handle to begin each of
its turns at less than half a turn: the tool is shown within ``LARGEST_TWIST`` of it. All this holds
before another program, too, whose tool may jump in every tick, and a wrench is always sent some
time after its sample.

Another program may step the scene and post the tool's pose when it has one, at any rate. Without a
velocity the tool is led to the posted pose within the time between the last two posts. Nothing is
known of the program's energy but the work W that it states, and W < 0 counts as 0: the tank begins
with a stated credit E_0, and the hand gets at most E_0 beyond what it put in, whatever is posted:

    D = E_0/q + Σ P − max(W, 0) >= 0,    q = force_scale / scale

An energy at the tool is q times as much at the hand, where the credit is stated. The scene's stored
energy is then D itself, because that is all that it may still give.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.codes import Part, State
from hapticbridge.kernel.force_level import limited_wrench
from hapticbridge.kernel.handle import device_from_scene, grip_pose, note_tool, scene_from_device
from hapticbridge.kernel.jit import compiled
from hapticbridge.kernel.law import (
    Spring,
    energy_at_level,
    law_wrench,
    length_at,
    limited,
    spring_energy,
    spring_length,
    springs,
    within,
)
from hapticbridge.kernel.ledger import take_scene_energies
from hapticbridge.kernel.mujoco_c import floats, ints, pointer_at
from hapticbridge.kernel.parameters import LARGEST_TWIST, RunParameters
from hapticbridge.kernel.pose import (
    Quaternion,
    Vector,
    add,
    canonical,
    cross,
    dot,
    norm,
    product,
    quaternion_exp,
    quaternion_of,
    rotation_between,
    scaled,
    store_quaternion,
    store_vector,
    subtract,
    vector_of,
)
from hapticbridge.kernel.record import PLANES
from hapticbridge.kernel.rigid_contact import opening

LONGEST = 3.0
"""Time beyond the handle of the newest result, in scene periods, for which the tool's motion is
foreseen. If the next result is later than that, the tool stays where it is shown."""

SLOWEST = 0.25
"""Longest time in s in which a posted pose is approached."""

TRIALS, NEAR = 8, 1.0 - 1e-6
"""Largest number of motions that are tried for the largest one that the tank pays for, and share of
the root of a parabola that is tried. Two or three are enough unless the force is at its level."""

ROUNDING = 2.0**-51
"""Largest share of two stated works by which their difference and the tank may be rounded."""

FASTEST, FASTEST_TURN = 1.0, 10.0
"""Speeds in m/s and rad/s up to which the tool passes on the coupling's whole wrench in time."""

SHOWN_DTYPE = np.dtype(
    [
        ("is_shown", "<i8"),
        ("is_beside", "<i8"),
        ("is_posted", "<i8"),
        ("failure", "<i8"),
        ("waits", "<i8"),
        ("scene_step", "<i8"),
        ("age", "<i8"),
        ("held_back", "<i8"),
        ("silence", "<i8"),
        ("longest_silence", "<i8"),
        ("contacts", "<i8"),
        ("planes", "<i8"),
        ("scene_period", "<f8"),
        ("timestep", "<f8"),
        ("lead", "<f8"),
        ("horizon", "<f8"),
        ("tank", "<f8"),
        ("passing", "<f8"),
        ("work", "<f8"),
        ("scene_work", "<f8"),
        ("before", "<f8", 7),
        ("newest", "<f8", 7),
        ("velocity", "<f8", 6),
        ("acceleration", "<f8", 6),
        ("normals", "<f8", 3 * PLANES),
        ("arms", "<f8", 3 * PLANES),
        ("gaps", "<f8", PLANES),
        ("speeds", "<f8", PLANES),
    ]
)
"""Sub-record ``shown``, written by this module alone. ``is_beside`` is 1 in the
scene's own loop, which writes ``before`` alone, ``is_posted`` if another program posts the poses.
``failure`` is the result of a step of the scene that is not usable, else ``OK``. ``waits`` is 1
while the scene has a handle,
``scene_step`` counts the scene's steps shown so far, ``age`` the ticks since the last handle was
handed over, ``held_back`` those in which the tank was too low for y*, ``silence`` those since the
newest result. ``lead`` in s is the age of the newest result when it was taken over, ``horizon`` the
time in s for which its motion is foreseen. ``tank`` D,
``passing``, ``work`` P of the present tick and ``scene_work`` W in J. ``before`` and ``newest`` are
the tool's poses before and after MuJoCo's newest step; a plane has a normal away from the surface,
the arm from the grip to the contact point, the gap at the pose ``before`` in m, and the speed
against its normal in m/s."""


def bind_shown(shown: Part, parameters: RunParameters) -> None:
    """Fills in the sub-record; nothing of it is used by a scene that steps in every tick.

    The energy ``passing`` while a result is under way is 2 (F v + F_r ω) T_s, at v = 1 m/s and
    ω = 10 rad/s.
    """
    shown["is_beside"] = parameters.is_beside or parameters.is_apart
    if not parameters.scene_ticks:
        return
    of_scene = parameters.of_scene
    power = of_scene.force_limit * FASTEST + of_scene.torque_limit * FASTEST_TURN
    shown["is_shown"], shown["scene_period"] = 1, of_scene.period
    shown["timestep"] = of_scene.period / of_scene.substeps
    shown["passing"] = 2.0 * power * of_scene.period
    shown["horizon"] = LONGEST * of_scene.period
    if parameters.credit > 0.0:
        shown["is_posted"], shown["tank"] = 1, parameters.tank_at_start


def tool_geoms(model: mujoco.MjModel, grip_site: int) -> NDArray[np.int32]:
    """Returns 1 for each geom that is rigid with the grip, else 0."""
    tool = model.body_weldid[model.site_bodyid[grip_site]]
    is_tool = model.body_weldid[model.geom_bodyid] == tool
    return np.ascontiguousarray(is_tool, dtype=np.int32)


def fail_scene(shown: Part, code: int) -> None:
    """Notes why the scene has no usable result, unless it is ``OK``; the tick then trips."""
    shown["failure"] = code


@compiled
def start_shown(state: NDArray[np.void]) -> None:
    """Shows the tool at its present pose, at rest, before a first result of the scene."""
    s = state[0]
    s.shown.waits = s.shown.age = s.shown.planes = s.shown.contacts = 0
    s.shown.lead = s.shown.work = 0.0
    for i in range(6):
        s.shown.velocity[i] = s.shown.acceleration[i] = 0.0
    for numbers in (s.shown.before, s.shown.newest):
        store_vector(numbers[0:3], vector_of(s.pose.tool_position))
        store_quaternion(numbers[3:7], quaternion_of(s.pose.tool_quaternion))


@compiled
def _credit(s: State) -> float:
    """Returns the energy in J of the coupling's springs at their levels, at the present gains."""
    linear, angular = springs(s)
    credit = energy_at_level(linear)
    if angular.stiffness > 0.0:
        credit += spring_energy(angular, min(length_at(angular, angular.level), np.pi))
    return float(credit)


# From the loop to the scene and back


@compiled
def hand_over(state: NDArray[np.void], sample: NDArray[np.void]) -> None:
    """Gives the scene's next step the present handle pose, as its sample.

    The handle is drawn toward the scene's tool where their springs hold more than the credit and
    the tank allow.
    """
    s = state[0]
    pose, scene_sample = s.pose, sample[0]
    linear, angular = springs(s)
    s.shown.age, s.shown.waits = 0, 1
    tool, orientation = vector_of(s.shown.newest), quaternion_of(s.shown.newest[3:7])
    stretch = subtract(vector_of(pose.handle_position), tool)
    twist = rotation_between(orientation, quaternion_of(pose.handle_quaternion))
    energy, energy_r = spring_energy(linear, norm(stretch)), spring_energy(angular, norm(twist))
    allowed = max(_credit(s) + s.shown.tank, 0.0)
    if energy + energy_r <= allowed:
        store_vector(scene_sample.position, vector_of(pose.handle_position))
        store_quaternion(scene_sample.quaternion, quaternion_of(pose.handle_quaternion))
        return
    share = allowed / (energy + energy_r)
    if energy > 0.0:
        stretch = within(stretch, spring_length(linear, share * energy))
    if energy_r > 0.0:
        twist = within(twist, spring_length(angular, share * energy_r))
    store_vector(scene_sample.position, add(tool, stretch))
    store_quaternion(
        scene_sample.quaternion, canonical(product(quaternion_exp(twist), orientation))
    )


@compiled
def take_over(state: NDArray[np.void], scene_state: NDArray[np.void]) -> None:
    """Takes over the result of a step of the scene: pose, motion, energies and contacts."""
    s, scene = state[0], scene_state[0]
    shown, motion = s.shown, scene.loop.motion
    rate = 1.0 / shown.scene_period
    # a blow changes the velocity at once; the next step knows more
    is_free = shown.contacts == 0 and scene.loop.active_contacts == 0 and shown.scene_step > 0
    for i in range(6):
        velocity = rate * motion[i]
        shown.acceleration[i] = rate * (velocity - shown.velocity[i]) if is_free else 0.0
        shown.velocity[i] = velocity
    for i in range(7):
        shown.before[i] = scene.shown.before[i]
    store_vector(shown.newest[0:3], vector_of(scene.pose.tool_position))
    store_quaternion(shown.newest[3:7], quaternion_of(scene.pose.tool_quaternion))
    shown.contacts = scene.loop.active_contacts
    shown.tank -= scene.energy.coupling_work - shown.scene_work
    shown.scene_work = scene.energy.coupling_work
    shown.scene_step += 1
    shown.silence = 0
    shown.lead = shown.age * s.run.period
    take_scene_energies(s.energy, scene.energy)
    _take_planes(s, scene)


@compiled
def take_posted(state: NDArray[np.void], posts: NDArray[np.void]) -> None:
    """Takes over a pose of the tool that another program has posted (``record.POST_DTYPE``)."""
    s, post = state[0], posts[0]
    shown, pose = s.shown, s.pose
    since = min(max(shown.silence, 1) * s.run.period, SLOWEST)
    work = max(post.work, 0.0)
    # less what the sums may round up, or a program that states much and takes it back would gain
    shown.tank -= work - shown.scene_work + ROUNDING * (work + shown.scene_work)
    shown.scene_work = work
    position, orientation = vector_of(post.pose), canonical(quaternion_of(post.pose[3:7]))
    store_vector(shown.before[0:3], position)
    store_quaternion(shown.before[3:7], orientation)
    from_position, from_orientation = position, orientation
    shown.horizon, shown.lead = LONGEST * since, 0.0
    for i in range(6):
        shown.acceleration[i] = 0.0
        shown.velocity[i] = post.velocity[i]
    if not post.has_velocity:
        shown.horizon, shown.lead = since, s.run.period
        from_position = vector_of(pose.tool_position)
        from_orientation = quaternion_of(pose.tool_quaternion)
        step = scaled(1.0 / since, subtract(position, from_position))
        turn = scaled(1.0 / since, rotation_between(from_orientation, orientation))
        store_vector(shown.velocity[0:3], step)
        store_vector(shown.velocity[3:6], turn)
    store_vector(shown.newest[0:3], from_position)
    store_quaternion(shown.newest[3:7], from_orientation)
    shown.planes = post.planes
    for i in range(post.planes):
        shown.gaps[i], shown.speeds[i] = post.gaps[i], 0.0
    for i in range(3 * post.planes):
        shown.normals[i], shown.arms[i] = post.normals[i], post.arms[i]
    shown.scene_step += 1
    shown.silence = shown.age = 0


@compiled
def note_contacts(s: State) -> None:
    """Notes the tool's pose at the start of MuJoCo's newest step, at which contacts were found.

    Must run in the scene's own loop before the kinematics are refreshed.
    """
    position, orientation = grip_pose(s.mj)
    store_vector(s.shown.before[0:3], position)
    store_quaternion(s.shown.before[3:7], orientation)


@compiled
def _take_planes(s: State, scene: State) -> None:
    """Notes the nearest surfaces to the tool, from the contacts of the step's start."""
    mj, shown, timestep = scene.mj, s.shown, scene.run.timestep
    is_tool = ints(mj.geom_is_tool, mj.ngeom)
    grip = vector_of(shown.before)
    moved = subtract(vector_of(shown.newest), grip)
    turn = rotation_between(quaternion_of(shown.before[3:7]), quaternion_of(shown.newest[3:7]))
    count = 0
    for c in range(ints(mj.ncon, 1)[0]):
        contact = pointer_at(mj.contact) + c * mj.contact_size
        geoms = ints(contact + mj.contact_geoms, 2)
        if geoms[0] < 0 or geoms[1] < 0:
            continue
        side = is_tool[geoms[1]] - is_tool[geoms[0]]
        if side == 0:
            continue
        # the normal points from the first geom to the second
        normal = scaled(float(side), vector_of(floats(contact + mj.contact_frame, 3)))
        arm = subtract(vector_of(floats(contact + mj.contact_point, 3)), grip)
        gap = max(opening(s, contact), 0.0)
        place = count
        if count < PLANES:
            count += 1
        else:
            place = int(np.argmax(shown.gaps))
            if shown.gaps[place] <= gap:
                continue
        pushed = max(-gap - dot(normal, add(moved, cross(turn, arm))), 0.0)
        store_vector(shown.normals[3 * place : 3 * place + 3], normal)
        store_vector(shown.arms[3 * place : 3 * place + 3], arm)
        shown.gaps[place] = gap
        shown.speeds[place] = pushed / timestep
    shown.planes = count


# To a loop of the device's own

ALIKE = 0.999
"""Least cosine of the angle between two surfaces that count as one, 2.6°."""


@compiled
def shown_to_device(state: NDArray[np.void], lead: float, numbers: NDArray[np.float64]) -> int:
    """Finds the tool as a device with a loop of its own is shown it, after a step.

    Must run while the contacts of the step exist.

    Args:
        state: The bound state.
        lead: Time in s by which the tool is foreseen: from the sample to its coming to the device.
        numbers: Receives, in the device's frame, the way from the handle to the tool in m and its
            velocity in m/s, the work W that the scene has taken in J at the hand, the rotation
            vector from the handle to the tool in rad and its angular velocity in rad/s, and per
            surface its normal and gap in m, the nearest surfaces first.

    Returns:
        The number of surfaces; none for a device that only turns.
    """
    s = state[0]
    shown, pose, run = s.shown, s.pose, s.run
    tool, turn = vector_of(pose.tool_position), quaternion_of(pose.tool_quaternion)
    store_vector(shown.newest[0:3], tool)
    store_quaternion(shown.newest[3:7], turn)
    _take_planes(s, s)
    numbers[6] = run.force_scale / run.scale * s.energy.coupling_work
    turning = scaled(1.0 / run.period, vector_of(s.loop.motion[3:6]))
    foreseen = product(quaternion_exp(scaled(lead, turning)), turn)
    twist = rotation_between(quaternion_of(pose.handle_quaternion), foreseen)
    store_vector(numbers[7:10], device_from_scene(run.axes, twist))
    store_vector(numbers[10:13], device_from_scene(run.axes, turning))
    velocity = scaled(1.0 / run.period, vector_of(s.loop.motion))
    ahead = scaled(lead, velocity)
    stretch = add(subtract(tool, vector_of(pose.handle_position)), ahead)
    scale = 1.0 / run.scale
    store_vector(numbers[0:3], device_from_scene(run.axes, scaled(scale, stretch)))
    store_vector(numbers[3:6], device_from_scene(run.axes, scaled(scale, velocity)))
    lacks = s.coupling.lacks_motor
    if lacks[0] + lacks[1] + lacks[2] == 3.0:
        return 0
    moved = add(subtract(tool, vector_of(shown.before)), ahead)
    # several contacts of one face are one surface to a tool that moves along lines
    turned = rotation_between(quaternion_of(shown.before[3:7]), turn)
    count = 0
    for first in range(13, numbers.size - 3, 4):
        nearest, least = -1, np.inf
        for k in range(shown.planes):
            normal = vector_of(shown.normals[3 * k : 3 * k + 3])
            arm = vector_of(shown.arms[3 * k : 3 * k + 3])
            gap = shown.gaps[k] + dot(normal, add(moved, cross(turned, arm)))
            for earlier in range(13, first, 4):
                known = scene_from_device(run.axes, vector_of(numbers[earlier : earlier + 3]))
                if dot(known, normal) > ALIKE:
                    gap = np.inf
            if gap < least:
                nearest, least = k, gap
        if nearest < 0:
            break
        normal = vector_of(shown.normals[3 * nearest : 3 * nearest + 3])
        store_vector(numbers[first : first + 3], device_from_scene(run.axes, normal))
        numbers[first + 3] = least / run.scale
        count += 1
    return count


# In every tick


@compiled
def _foreseen(s: State) -> tuple[Vector, Quaternion]:
    """Returns y*, where the tool is by now as far as is known."""
    shown = s.shown
    q = min(shown.age * s.run.period + shown.lead, shown.horizon)
    v, a, half = shown.velocity, shown.acceleration, 0.5 * q * q
    step = add(scaled(q, vector_of(v)), scaled(half, vector_of(a)))
    turn = add(scaled(q, vector_of(v[3:6])), scaled(half, vector_of(a[3:6])))
    orientation = product(quaternion_exp(turn), quaternion_of(shown.newest[3:7]))
    position = add(vector_of(shown.newest), step)
    if shown.planes > 0:
        position = _outside(shown, position, orientation, q + shown.timestep)
    return position, canonical(orientation)


@compiled
def _outside(shown: Part, position: Vector, orientation: Quaternion, time: float) -> Vector:
    """Returns a position of the tool, moved out of the planes, a time in s after ``before``."""
    turn = rotation_between(quaternion_of(shown.before[3:7]), orientation)
    for _ in range(4):
        moved = subtract(position, vector_of(shown.before))
        has_moved = False
        for k in range(shown.planes):
            normal = vector_of(shown.normals[3 * k : 3 * k + 3])
            arm = vector_of(shown.arms[3 * k : 3 * k + 3])
            free = shown.gaps[k] + time * shown.speeds[k]
            inside = -free - dot(normal, add(moved, cross(turn, arm)))
            if inside > 0.0:
                position = add(position, scaled(inside, normal))
                moved = add(moved, scaled(inside, normal))
                has_moved = True
        if not has_moved:
            break
    return position


@compiled
def _pulled(s: State, position: Vector, orientation: Quaternion) -> tuple[Vector, Vector]:
    """Returns the coupling's stretch in m and twist in rad with the tool at a pose."""
    stretch = subtract(vector_of(s.pose.handle_position), position)
    return stretch, rotation_between(orientation, quaternion_of(s.pose.handle_quaternion))


@compiled
def _is_late(s: State) -> bool:
    """Returns True if a wrench may act after the tool has jumped."""
    return bool(s.shown.is_posted or s.timing.device_delay_ns > 0)


@compiled
def _shown_at(
    s: State, share: float, step: Vector, turn: Vector
) -> tuple[Vector, Quaternion, Vector, Vector, Vector, Vector]:
    """Returns pose, wrench and motion after a share of a motion from the pose shown last."""
    moved, turned = scaled(share, step), scaled(share, turn)
    last = quaternion_of(s.pose.tool_quaternion)
    position = add(vector_of(s.pose.tool_position), moved)
    orientation = canonical(product(quaternion_exp(turned), last))
    _, twist = _pulled(s, position, orientation)
    if _is_late(s) and norm(twist) > LARGEST_TWIST:
        back = subtract(twist, within(twist, LARGEST_TWIST))
        orientation = canonical(product(quaternion_exp(back), orientation))
        turned = rotation_between(last, orientation)
    stretch, twist = _pulled(s, position, orientation)
    force, torque = law_wrench(s, stretch, twist, moved, turned)
    force, torque = limited_wrench(s, force, torque)
    return position, orientation, force, torque, moved, turned


@compiled
def _released(
    spring: Spring, before: Vector, after: Vector, u: Vector, motion: Vector, is_late: bool
) -> float:
    """Returns the part of P in J that one spring has.

    Args:
        spring: That of translation or of rotation.
        before: Stretch in m or twist in rad before the tool's motion.
        after: The same after it.
        u: Force in N or torque in N m after it, with the damper's.
        motion: The tool's motion in m, or its rotation vector in rad.
        is_late: True if the wrench may act after the motion.
    """
    elastic = limited(spring, scaled(spring.stiffness, after))
    released = spring_energy(spring, norm(before)) - spring_energy(spring, norm(after))
    released += dot(subtract(u, elastic), motion)
    if not is_late:
        return released
    if spring.stiffness > 0.0:
        change = subtract(elastic, limited(spring, scaled(spring.stiffness, before)))
        released -= 0.5 * dot(change, change) / spring.stiffness
    return min(released, dot(u, motion))


@compiled
def _released_energy(
    s: State, before: tuple[Vector, Vector], share: float, step: Vector, turn: Vector
) -> float:
    """Returns P, the energy in J that the coupling gives if the tool moves by a share."""
    position, orientation, force, torque, moved, turned = _shown_at(s, share, step, turn)
    (linear, angular), is_late = springs(s), _is_late(s)
    stretch, twist = _pulled(s, position, orientation)
    by_force = _released(linear, before[0], stretch, force, moved, is_late)
    return by_force + _released(angular, before[1], twist, torque, turned, is_late)


@compiled
def _paid_share(
    s: State,
    before: tuple[Vector, Vector],
    motion: tuple[Vector, Vector],
    ends: tuple[float, float],
) -> tuple[float, float]:
    """Returns a share of a motion that the tank pays for, and its P in J.

    Below the force level P is a parabola of the share, a r − c r², so P/r is a line. Where the
    line's root cannot be, smaller shares are tried. ``before`` is stretch and twist before the
    motion, and ``ends`` has P of the whole motion and the least P.
    """
    step, turn = motion
    last_released, least = ends
    share, work, high, last, trial = 0.0, 0.0, 1.0, 1.0, 0.5
    for _ in range(TRIALS):
        released = _released_energy(s, before, trial, step, turn)
        if released < least:
            high = trial
        else:
            share, work = trial, released
        curve = (released / trial - last_released / last) / (last - trial)
        slope = released / trial + curve * trial
        last, last_released, trial = trial, released, 0.5 * (share + high)
        if share == 0.0:
            trial = high / 16.0
        if curve > 0.0:
            root = NEAR * (slope + np.sqrt(slope * slope - 4.0 * curve * least)) / (2.0 * curve)
            if share > 0.0 and abs(root - share) <= (1.0 - NEAR) * share:
                break
            if share < root < high:
                trial = root
    return share, work


@compiled
def shown_wrench(s: State) -> tuple[Vector, Vector, Vector, Vector]:
    """Shows the tool in the present tick.

    Returns:
        Force in N and torque in N m on the tool, and its motion in m and rotation vector in rad.
    """
    shown, pose = s.shown, s.pose
    goal, orientation = _foreseen(s)
    last = quaternion_of(pose.tool_quaternion)
    step = subtract(goal, vector_of(pose.tool_position))
    turn = rotation_between(last, orientation)
    before = _pulled(s, vector_of(pose.tool_position), last)
    share, least = 1.0, -max(shown.tank, 0.0)
    work = _released_energy(s, before, share, step, turn)
    if work < least:
        shown.held_back += 1
        share, work = _paid_share(s, before, (step, turn), (work, least))
    shown.work = work
    shown.tank += work
    if shown.age > 0 or shown.is_posted:  # another program may post in every tick
        shown.tank = min(shown.tank, 2.0 * _credit(s) + shown.passing)
    shown.age += 1
    shown.silence += 1
    shown.longest_silence = max(shown.longest_silence, shown.silence)
    position, orientation, force, torque, moved, turned = _shown_at(s, share, step, turn)
    note_tool(pose, position, orientation, (0.0, 0.0, 0.0))
    return force, torque, moved, turned
