"""All recordings of a folder, audited on all cores, worst first."""

from pathlib import Path

import hapticbridge as hb
from hapticbridge.audit.batch import audit_all

if __name__ == "__main__":
    folder = Path("runs")
    folder.mkdir(exist_ok=True)
    for name in ("point_mass", "virtual_wall"):
        file = folder / f"{name}.mcap"
        with hb.Bridge(name, clock=hb.SimulatedClock(), recording=file) as bridge:
            bridge.run(duration=1.0)
    table = audit_all(sorted(folder.glob("*.mcap")))
    for file, verdict, margin in zip(
        table.texts("file"), table.texts("verdict"), table.numbers("margin"), strict=True
    ):
        print(f"{verdict:<10} {margin:6.2f}  {file}")
