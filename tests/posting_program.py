"""A program that shows its tool at random, in ways that try to give energy to a hand."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from hapticbridge.kernel.record import PLANES, POST_DTYPE
from hapticbridge.kernel.state import BoundKernel

RANDOM, JUMPING, FREEZING, OPPOSING, LAGGING, WANDERING = range(6)
"""Kinds of programs: poses around the handle, far ones, one that stops following, a tool that is
shown against the hand's motion, one that follows it late, and one that does not know of it."""


class PostingProgram:
    """Program with random habits.

    Args:
        rng: Source of its choices.
        period: Period of the loop in s.
        kernel: The loop's kernel, of which the program knows the handle's pose.
    """

    def __init__(self, rng: np.random.Generator, period: float, kernel: BoundKernel) -> None:
        self._rng, self._pose = rng, kernel.state["pose"]
        self._kernel = kernel
        self._kind = int(rng.integers(6))
        self._interval = 1.0 / (period * 10 ** rng.uniform(0.7, 2.7))  # 5 to 500 Hz, in ticks
        self._jitter = rng.uniform(0.0, 1.0)
        self._size = 10 ** rng.uniform(-4.0, -0.7)
        self._has_velocity, self._has_planes, self._places = rng.random(3) < 0.4
        self._lies = float(rng.choice([0.0, 0.0, 1.0]))
        self._due, self._work = 0.0, 0.0
        self._last = self._home = self._handle()
        self._shown = self._home.copy()

    def _handle(self) -> NDArray[np.float64]:
        pose = self._pose[0]
        return np.array([*pose["handle_position"], *pose["handle_quaternion"]])

    def post(self, tick: int) -> NDArray[np.void]:
        """Returns the post that the loop takes over in a tick; empty without one."""
        if tick < self._due:
            return np.zeros(0, POST_DTYPE)
        rng = self._rng
        self._due = tick + self._interval * (1.0 + self._jitter * rng.uniform(-1.0, 3.0))
        post, shown = np.zeros(1, POST_DTYPE), self._next(self._handle(), tick)
        post["pose"] = self._shown = shown
        if self._places and rng.random() < 0.02:
            self._kernel.handle_reset(shown.tolist())
        post["has_velocity"] = self._has_velocity
        post["velocity"] = rng.standard_normal(6) * 10 ** rng.uniform(-3.0, 1.0)
        if self._has_planes:
            post["planes"] = rng.integers(PLANES + 1)
            normals = rng.standard_normal((PLANES, 3))
            normals /= np.linalg.norm(normals, axis=1)[:, None]
            post["normals"], post["arms"] = normals.ravel(), 0.05 * rng.standard_normal(3 * PLANES)
            post["gaps"] = np.abs(0.01 * rng.standard_normal(PLANES))
        self._work += self._lies * 0.1 * rng.standard_normal()
        post["work"] = self._work
        return post

    def _next(self, handle: NDArray[np.float64], tick: int) -> NDArray[np.float64]:
        rng, last = self._rng, self._last
        self._last, shown = handle, handle.copy()
        noise = self._size * rng.standard_normal(3)
        if self._kind == RANDOM:
            shown[:3] += noise
        elif self._kind == JUMPING:
            shown[:3] += 10.0 * noise * (rng.random() < 0.2)
        elif self._kind == FREEZING and tick // 400 % 2:
            shown = self._shown.copy()
        elif self._kind == OPPOSING:
            shown[:3] -= rng.uniform(0.0, 5.0) * (handle[:3] - last[:3])
        elif self._kind == LAGGING:
            shown[:3] = self._shown[:3] + 0.3 * (handle[:3] - self._shown[:3])
        elif self._kind == WANDERING:
            shown = self._shown.copy()
            shown[:3] += 0.1 * noise
        if self._kind in (RANDOM, JUMPING, WANDERING):
            orientation = shown[3:].copy()
            mujoco.mju_quatIntegrate(orientation, rng.standard_normal(3), 10.0 * self._size)
            shown[3:] = orientation
        return shown
