"""``hapticbridge bound``."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from hapticbridge.cli.terminal import out, plain, print_json, write_figure
from hapticbridge.cli.zwidth import DEFAULT_RATE, next_command
from hapticbridge.clock import period_of
from hapticbridge.coupling import Coupling
from hapticbridge.plotting import check_ending
from hapticbridge.rendering import RunCoupling, default_method
from hapticbridge.theory.compensation import largest_effective_damping, law_damping
from hapticbridge.theory.transfer import scalar
from hapticbridge.theory_plots import Alternative, alternatives, draw_alternatives


@dataclass(frozen=True, slots=True)
class Bound:
    """Compute the device damping that a coupling needs.

    Alternative laws are listed beside it. K and B are the requested ones; the law of the default
    method uses B - KT/2, at least 0. Exit code 1 if --device-damping does not suffice.

    Example:
        hapticbridge bound --stiffness 2000 --damping 1 --rate 1000
    """

    stiffness: float
    """Coupling stiffness K in N/m."""
    damping: float = 0.0
    """Requested damping B of the coupling in N s/m."""
    rate: float = DEFAULT_RATE
    """Ticks per second."""
    filter_time: float | None = None
    """Time constant in s of the low-pass among the alternatives; by default one period."""
    device_damping: float | None = None
    """Physical damping b of the device in N s/m: does it suffice?"""
    plot: Path | None = None
    """Draw the damping needed over frequency into this picture (.png, .svg or .pdf)."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print it as JSON; null where no damping suffices."""

    def execute(self) -> int:
        """Computes and prints; returns the exit code."""
        check_ending(self.plot)
        b = self.device_damping
        if b is not None:
            scalar("device damping", b, "N s/m", positive=True)
        period = period_of(self.rate)
        coupling = Coupling(self.stiffness, self.damping, 0.0, 0.0)
        filter_time = period if self.filter_time is None else self.filter_time
        ways = alternatives(coupling, period, filter_time)
        holds = b is None or b >= ways[0].needed
        if self.as_json:
            print_json(self._facts(ways, period))
        else:
            self._print(ways, period)
        if self.plot is not None:
            title = f"K = {self.stiffness:g} N/m, B = {self.damping:g} N s/m at {self.rate:g} Hz"
            write_figure(draw_alternatives(ways, title, b), self.plot)
        return 0 if holds else 1

    def _facts(self, ways: tuple[Alternative, ...], period: float) -> dict[str, object]:
        b = self.device_damping
        return {
            "needed": ways[0].needed,
            "frequency_hz": _hertz(ways[0]),
            "holds": None if b is None else b >= ways[0].needed,
            "method": default_method().name,
            "coupling": asdict(self._coupling(period)),
            "largest_stiffness": self._largest_stiffness(period),
            "alternatives": [
                {"name": way.name, "needed": way.needed, "frequency_hz": _hertz(way)}
                for way in ways
            ],
        }

    def _coupling(self, period: float) -> RunCoupling:
        requested = Coupling(self.stiffness, self.damping, 0.0, 0.0)
        return RunCoupling.of(default_method(), period, requested)

    def _largest_stiffness(self, period: float) -> float | None:
        """Returns the largest K that the device bears; None without a device, 0 if none."""
        b = self.device_damping
        if b is None:
            return None
        return 2 * b / period if self.damping <= b else 0.0

    def _print(self, ways: tuple[Alternative, ...], period: float) -> None:
        b, method = self.device_damping, default_method()
        (sentence,) = self._coupling(period).sentences()
        out.print(f"{sentence}; the device needs b >= KT/2 + B_law")
        table = Table("", "damping needed", "most at", box=None, pad_edge=False)
        if b is not None:
            table.add_column("holds")
        for way in ways:
            amount = f"{way.needed:.4g} N s/m" if math.isfinite(way.needed) else "none suffices"
            verdict = [] if b is None else ["yes" if b >= way.needed else "no"]
            table.add_row(way.name, amount, _where(way), *verdict)
        out.print(table)
        least = method.compensated_share * self.stiffness * period
        if self.damping < least:
            out.print(
                f"method {method.name} cannot show less than B = {least:.4g} N s/m at this "
                "stiffness and rate"
            )
        if b is None:
            return
        needed = ways[0].needed
        if b >= needed:
            out.print(f"device damping {b:g} >= {needed:.4g} N s/m: passive in any hand")
            out.print(f"it bears any K up to {2 * b / period:.4g} N/m with any B up to {b:g} N s/m")
            shown = max(self.damping, least)
            out.print(f"next: {plain(next_command(self.stiffness, shown, self.rate))}")
            return
        out.print(f"device damping {b:g} < {needed:.4g} N s/m: [red]not passive in any hand[/]")
        self._print_remedies(b, needed, period)

    def _print_remedies(self, b: float, needed: float, period: float) -> None:
        lag, changes = default_method().compensated_share, []
        if law_damping(self.stiffness, self.damping, period, lag) > 0:
            stiffness = min(self.stiffness, 2 * b / period)
            most = largest_effective_damping(b, stiffness, period, lag)
            changes.append(f"lower the damping to {most:.4g} N s/m")
        if self.stiffness * period > 2 * b:
            changes.append(f"lower the stiffness to {2 * b / period:.4g} N/m")
            changes.append(f"raise the rate to {self.stiffness / (2 * b):.4g} Hz")
        if len(changes) == 3:
            out.print(f"  {changes[0]}, and {changes[1]} or {changes[2]}, or")
        else:
            for change in changes:
                out.print(f"  {change}, or")
        out.print(f"  take a device with {needed:.4g} N s/m")


def _hertz(way: Alternative) -> float | None:
    return None if way.frequency is None else way.frequency / (2 * math.pi)


def _where(way: Alternative) -> str:
    if (hertz := _hertz(way)) is None:
        return "every frequency" if math.isfinite(way.needed) else "-"
    return f"{hertz:.4g} Hz" if hertz else "low frequency"
