"""A point of a chart: what was set, what it cost, how wrong it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from hapticbridge.coupling import Coupling
from hapticbridge.study.chart.score import PASSIVE, Score
from hapticbridge.study.chart.setting import SHIPPED, Setting
from hapticbridge.study.chart.timing import Cost


@dataclass(frozen=True, slots=True)
class Measurement:
    """One point in one panel.

    Attributes:
        panel: Key of the panel.
        setting: How it was simulated.
        cost: What it cost.
        score: How wrong it was.
        chosen: Contacts and solver as the engine got them, by name.
        limit_apart: Where errors are counted from each method's own limit: how far that limit
            lies from the one that most methods agree on, in JND. 0 where they are counted from
            the truth.
    """

    panel: str
    setting: Setting
    cost: Cost
    score: Score
    chosen: Mapping[str, str | int] = field(default_factory=dict)
    limit_apart: float = 0.0

    @property
    def is_comparable(self) -> bool:
        """Whether its error can be compared with those of other methods.

        Not where it is smaller than the distance of what the methods' errors are counted from.
        """
        return not self.score.felt < self.limit_apart

    @property
    def is_sound(self) -> bool:
        """Whether the environment was passive and the run stayed in contact."""
        return self.score.verdict in PASSIVE

    @property
    def is_usual(self) -> bool:
        """Whether nothing but method and period was chosen."""
        setting = self.setting
        is_plain = setting.contact == SHIPPED and setting.iterations is None
        return is_plain and setting.substeps == 1

    def cells(self, workload: str, coupling: Coupling) -> dict[str, object]:
        """Returns the row of a table: every choice, every number."""
        setting, method = self.setting, self.setting.method
        used = method.used(coupling, setting.timestep)
        return {
            "workload": workload,
            "panel": self.panel,
            "engine": setting.engine,
            "method": method.name,
            "integrator": method.integrator,
            "period_s": setting.period,
            "substeps": setting.substeps,
            "timestep_s": setting.timestep,
            "contact": setting.contact,
            **self.chosen,
            "stiffness": coupling.stiffness,
            "damping": coupling.damping,
            "rotational_stiffness": coupling.rotational_stiffness,
            "rotational_damping": coupling.rotational_damping,
            "damping_used": used.damping,
            "rotational_damping_used": used.rotational_damping,
            **{f"cost_{name}": value for name, value in asdict(self.cost).items()},
            **{f"error_{name}": value for name, value in asdict(self.score).items()},
            "limit_apart": self.limit_apart,
        }
