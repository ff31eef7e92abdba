"""Write ``hb_constants.h``, the constants that firmware for home-made devices has from Python."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hapticbridge.device.own_loop import SURFACES
from hapticbridge.device.rawhid import protocol
from hapticbridge.kernel import parameters, shown_tool

TARGET = Path(protocol.__file__).with_name("firmware") / "hb_constants.h"


def header() -> str:
    """Returns the file's content."""
    numbers = {
        "HB_FRAME_BYTES": protocol.FRAME_BYTES,
        "HB_MAGIC": protocol.MAGIC,
        "HB_VERSION": protocol.VERSION,
        "HB_LONGEST_WATCHDOG_MS": protocol.MAX_WATCHDOG_MS,
        **{f"HB_KIND_{kind.name}": int(kind) for kind in protocol.Kind},
        **{f"HB_CAUSE_{cause.name}": int(cause) for cause in protocol.Cause},
        "HB_OPTION_ENABLE": protocol.ENABLE,
        "HB_OPTION_HAS_VELOCITY": protocol.HAS_VELOCITY,
        "HB_OPTION_IS_PLACED": protocol.IS_PLACED,
        "HB_OPTION_PLANE": protocol.PLANE,
        "HB_PLANES": SURFACES,
        "HB_TRIALS": shown_tool.TRIALS,
    }
    reals = {"HB_NEAR": shown_tool.NEAR, "HB_SLOWEST": shown_tool.SLOWEST}
    reals |= {"HB_LONGEST": shown_tool.LONGEST, "HB_LARGEST_TWIST": parameters.LARGEST_TWIST}
    reals |= {"HB_SPEED_STEP": protocol.SPEED_STEP, "HB_TURN_STEP": protocol.TURN_STEP}
    lines = [f"static const int {name} = {value};" for name, value in numbers.items()]
    lines += [f"static const float {name} = {value!r}f;" for name, value in reals.items()]
    return "\n".join(
        [
            "// Written by scripts/make_firmware_constants.py; do not edit.",
            "#ifndef HB_CONSTANTS_H",
            "#define HB_CONSTANTS_H",
            "",
            *lines,
            "",
            "#endif",
            "",
        ]
    )


def main() -> int:
    """Writes the file, or compares it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="compare the file; 1 if it differs")
    if parser.parse_args().check:
        return int(TARGET.read_text(encoding="utf-8") != header())
    TARGET.write_text(header(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
