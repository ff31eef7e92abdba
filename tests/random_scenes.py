"""Random MJCF scenes and options of a run: what a file may hold, in combinations nobody wrote."""

from __future__ import annotations

from random import Random

TIME_STEPS = ("0.0005", "0.001", "0.002", "0.005", "0.01")
SOLREFS = ("0.02 1", "0.005 1", "-1000 -10", "-5000 0", "0.02 0.1")
SOLIMPS = ("0 .99 .003 .9 6", "0.9 0.95 0.001", "0.99 0.9999 0.01")
FLAGS = (
    *("gravity", "limit", "contact", "equality", "frictionloss", "spring", "damper", "warmstart"),
    *("filterparent", "actuation", "eulerdamp", "multiccd", "energy", "sleep"),
)

OPTIONS = (
    ("--rate", "500"),
    ("--rate", "2000"),
    ("--substeps", "3"),
    ("--scene-rate", "250"),
    ("--scene-rate", "50"),
    ("--stiffness", "300"),
    ("--damping", "1"),
    ("--method", "implicit"),
    ("--contact", "scene"),
    ("--scale", "3"),
    ("--force-scale", "0.3"),
    ("--stretch-limit", "0.02"),
    ("--energy-limit", "inf"),
    ("--controller", "off"),
    ("--no-tool-weight",),
    ("--impact-pulses", "0.7"),
    ("--as-is",),
    ("--device", "simulated:damping=3,delay=2"),
    ("--device", "simulated:hand=none"),
)


class RandomScene:
    """Scene of up to five bodies in chains, with what joins, drives and measures them.

    Attributes:
        xml: The file.
        grip: Site that the hand holds.
        joint: Hinge or slide for a grip axis; empty without one.
    """

    def __init__(self, seed: int) -> None:
        self._random, self._count = Random(seed), 0
        self._scalars: list[str] = []
        options = (
            f'timestep="{self._one(TIME_STEPS)}" '
            f'integrator="{self._one(("Euler", "RK4", "implicit", "implicitfast"))}" '
            f'cone="{self._one(("pyramidal", "elliptic"))}" '
            f'solver="{self._one(("PGS", "CG", "Newton"))}"'
        )
        options += self._may(0.3, f' gravity="{self._numbers(3, -10, 10)}"')
        options += self._may(0.2, f' density="{self._numbers(1, 0, 900)}" viscosity="0.01"')
        options += self._may(0.1, ' noslip_iterations="3"')
        flags = " ".join(
            f'{flag}="{self._one(("enable", "disable"))}"'
            for flag in FLAGS
            if self._random.random() < 0.06
        )
        bodies = [self._body(0)]
        while self._random.random() < 0.6 and self._count < 5:
            bodies.append(self._body(0))
        self.grip = f"s{self._random.randint(1, self._count)}"
        self.joint = self._one(self._scalars) if self._scalars else ""
        parts = self._equality() + self._tendons() + self._actuators()
        self.xml = (
            f"<mujoco><option {options}><flag {flags}/></option><worldbody>"
            f'<geom type="plane" size="1 1 .1" pos="0 0 {self._numbers(1, -0.3, -0.1)}"/>'
            f"{''.join(bodies)}</worldbody>{parts}</mujoco>"
        )

    def options(self) -> list[str]:
        """Returns up to three options of ``run``, with a grip axis now and then."""
        words = [w for option in self._random.sample(OPTIONS, 3) for w in option]
        if self.joint and self._random.random() < 0.2:
            words += ["--grip-axis", self.joint, "--grip-scale", "2"]
        return words

    def _one(self, choices: tuple[str, ...] | list[str]) -> str:
        return self._random.choice(choices)

    def _may(self, share: float, text: str) -> str:
        return text if self._random.random() < share else ""

    def _numbers(self, count: int, low: float, high: float) -> str:
        return " ".join(f"{self._random.uniform(low, high):.4g}" for _ in range(count))

    def _body(self, depth: int) -> str:
        self._count += 1
        own = self._count
        text = (
            f'<body name="b{own}" pos="{self._numbers(3, -0.08, 0.08)}" '
            f'euler="{self._numbers(3, 0, 90)}" gravcomp="{self._one(("0", "0", "0", "1"))}">'
        )
        is_free = depth == 0 and self._random.random() < 0.4
        text += "<freejoint/>" if is_free else self._joint(own) + self._may(0.4, self._joint(own))
        text += self._geom() + f'<site name="s{own}" pos="{self._numbers(3, -0.02, 0.02)}"/>'
        if depth < 3 and self._count < 5 and self._random.random() < 0.5:
            text += self._body(depth + 1)
        return text + "</body>"

    def _joint(self, body: int) -> str:
        kind = self._one(("hinge", "slide"))
        name = f"j{body}_{len(self._scalars)}"
        self._scalars.append(name)
        reach = 0.05 if kind == "slide" else 90.0
        low, high = -self._random.random() * reach, self._random.random() * reach
        return (
            f'<joint name="{name}" type="{kind}" axis="{self._numbers(3, 0.1, 1)}"'
            + self._may(0.4, f' range="{low:.4g} {high:.4g}"')
            + self._may(0.3, f' damping="{self._numbers(1, 0, 0.5)}"')
            + self._may(0.3, f' stiffness="{self._numbers(1, 0, 50)}"')
            + self._may(0.2, f' frictionloss="{self._numbers(1, 0, 0.2)}"')
            + self._may(0.2, f' armature="{self._numbers(1, 0, 0.05)}"')
            + "/>"
        )

    def _geom(self) -> str:
        kind = self._one(("sphere", "box", "capsule", "cylinder", "ellipsoid"))
        sizes = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)
        return (
            f'<geom type="{kind}" size="{self._numbers(sizes, 0.005, 0.03)}" '
            f'mass="{self._numbers(1, 0.01, 0.5)}" euler="{self._numbers(3, 0, 180)}"'
            + self._may(0.2, f' margin="{self._numbers(1, 0, 0.01)}"')
            + self._may(0.2, f' condim="{self._one(("1", "3", "4", "6"))}"')
            + self._may(0.2, f' solref="{self._one(SOLREFS)}"')
            + self._may(0.2, f' solimp="{self._one(SOLIMPS)}"')
            + self._may(0.1, ' contype="0" conaffinity="0"')
            + "/>"
        )

    def _equality(self) -> str:
        text = self._may(0.2, f'<weld body1="b{self._random.randint(1, self._count)}"/>')
        if self._count > 1:
            one, other = self._random.sample(range(1, self._count + 1), 2)
            text += self._may(0.3, f'<connect body1="b{one}" body2="b{other}" anchor="0 0 0"/>')
        return f"<equality>{text}</equality>"

    def _tendons(self) -> str:
        if self._count < 2:
            return ""
        one, other = self._random.sample(range(1, self._count + 1), 2)
        way = f'<site site="s{one}"/><site site="s{other}"/>'
        cord = f'<spatial stiffness="{self._numbers(1, 0, 100)}">{way}</spatial>'
        return f"<tendon>{self._may(0.3, cord)}</tendon>"

    def _actuators(self) -> str:
        if not self._scalars:
            return ""
        motor = f'<motor joint="{self._one(self._scalars)}" gear="{self._numbers(1, -2, 2)}"/>'
        servo = f'<position joint="{self._one(self._scalars)}" kp="{self._numbers(1, 1, 100)}"/>'
        return f"<actuator>{self._may(0.3, motor)}{self._may(0.3, servo)}</actuator>"
