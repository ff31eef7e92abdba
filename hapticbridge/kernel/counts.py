"""What the guard had counted when a recording begins in mid-run.

Energies of a recording count from its first tick; what the guard holds against the device must not:
whoever starts recorders one after the other would be given the energy limit with each of them. So
these counts go on, the recording's metadata hold them, and its audit begins with them.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from hapticbridge.errors import HapticBridgeError

_AXES = 6
"""Three of translation, three of rotation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """What the guard had counted before the first tick, all in J.

    Attributes:
        given: What the device was given beyond what its damping burnt (``kernel.account``).
        stored: What the scene stored when the whole run began: what it gives up of that counts as
            its own.
        account: What the energy account of both ports owes; below zero: what it has saved.
        axes: Likewise of each axis (6).
        excess: What the environment created beyond its slack.
        unfelt: What the scene took up while the force was off by command, and still has.

    Raises:
        HapticBridgeError: A value is not finite, or the axes are not six.
    """

    given: float
    stored: float
    account: float
    axes: tuple[float, ...]
    excess: float
    unfelt: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.axes, tuple) or len(self.axes) != _AXES:
            raise HapticBridgeError(f"counts: axes is {self.axes!r:.80}; it must be 6 numbers")
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        del values["axes"]
        for name, value in (*values.items(), *(("axes", value) for value in self.axes)):
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise HapticBridgeError(f"counts: {name} is {value!r:.80}; it must be a number")
            if not math.isfinite(value):
                raise HapticBridgeError(f"counts: {name} is {value!r} J; it must be finite")

    @classmethod
    def of(cls, state: NDArray[np.void]) -> Counts:
        """Reads them out of the kernel's state (``STATE_DTYPE``) between two ticks."""
        s = state[0]
        return cls(
            given=float(s["given"]),
            stored=float(s["first_energy"]),
            account=float(s["account"]),
            axes=tuple(s["axis_account"].tolist()),
            excess=float(s["excess"]),
            unfelt=float(s["unfelt"]),
        )

    def put(self, state: NDArray[np.void]) -> None:
        """Writes them into the kernel's state, before its first tick."""
        state["given"], state["first_energy"] = self.given, self.stored
        state["account"], state["axis_account"] = self.account, self.axes
        state["excess"], state["unfelt"] = self.excess, self.unfelt

    def to_json(self) -> str:
        """Returns them as a recording keeps them; each number reads back to the same double."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Counts:
        """Reads what ``to_json`` wrote.

        Raises:
            HapticBridgeError: The text is not that, or a value is out of range.
        """
        try:
            values = dict(json.loads(text))
            values["axes"] = tuple(values["axes"])
            return cls(**values)
        except (ValueError, TypeError, KeyError, RecursionError):
            raise HapticBridgeError(
                f"metadata 'counts' is {text!r:.80}; it does not name what the guard had counted"
            ) from None
