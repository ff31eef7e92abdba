"""A LeRobot teleoperator that LeRobot itself finds, and a dataset recorded through it."""

from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import build_dataset_frame, hw_to_dataset_features
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
Config = TeleoperatorConfig.get_choice_class("hapticbridge")
teleop = make_teleoperator_from_config(Config(recording="own.mcap", is_simulated=True))
names, robot = teleop.feedback_features, {"ee.x": 0.3, "ee.y": 0.0, "ee.z": 0.2}
robot |= dict.fromkeys(set(names) - set(robot), 0.0)
features = hw_to_dataset_features(teleop.action_features, "action")
features |= hw_to_dataset_features(names, "observation")
dataset = LeRobotDataset.create("local/own", fps=50, features=features, root="own_dataset")
with teleop:
    loop = teleop.loop
    for _ in range(100):
        teleop.send_feedback(robot)
        action = teleop.get_action()
        dataset.add_frame(
            build_dataset_frame(features, robot, "observation")
            | build_dataset_frame(features, action, "action")
            | {"task": "follow the hand"}
        )
        robot = {name: robot[name] + 0.3 * (action[name] - robot[name]) for name in names}
        loop.advance(0.02)  # not in real time
dataset.save_episode()
dataset.finalize()
loaded = LeRobotDataset("local/own", root=Path("own_dataset"))
print(f"{len(loaded)} frames, {loop.summary['peak_force']:.2f} N, {loop.summary['verdict']}")
