"""What most workloads are: a scene on a stage, led along one motion and judged in one way."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

from hapticbridge.coupling import Coupling
from hapticbridge.errors import StudyError
from hapticbridge.kernel.codes import DIRECT, WELD
from hapticbridge.study.chart.scene_run import SceneRun, Stages, Take
from hapticbridge.study.chart.score import Score
from hapticbridge.study.chart.setting import Setting
from hapticbridge.study.chart.workload import References, Run


class Staged(ABC):
    """A workload whose every point is its stage at another setting.

    Args:
        coupling: K and B.
        stages: Where it runs.
        references: The methods' own limits, where it compares with them.

    Attributes:
        needs_tool: What a method that does without the tool's own dynamics fails to do, as in
            "method 'weld' …"; empty where the workload suits it.
    """

    needs_tool: ClassVar[str] = ""

    def __init__(
        self, coupling: Coupling, stages: Stages, references: References | None = None
    ) -> None:
        self.coupling = coupling
        self.references = references
        self._stages = stages

    def run(self, setting: Setting) -> Run:
        """Prepares a point.

        Raises:
            StudyError: The method does without the tool's own dynamics, and that is what is judged.
        """
        method = setting.method
        if self.needs_tool and method.scheme in (WELD, DIRECT):
            raise StudyError(f"method '{method.name}' {self.needs_tool}")
        return SceneRun(self._stages.for_method(setting), setting, self._judge)

    @abstractmethod
    def _judge(self, takes: Sequence[Take]) -> Mapping[str, Score]:
        """Says what the takes of a point are worth, by ``Panel.key``."""
