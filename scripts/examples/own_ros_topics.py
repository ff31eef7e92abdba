"""Handle, tool and wrenches of a device loop as live ROS 2 topics, for a viewer, without ROS."""

import hapticbridge as hb
from hapticbridge.program.ros_topics import RosTopics

tool = [0.0, 0.0, 0.1]
with (
    hb.DeviceLoop("simulated", recording="own.mcap", is_simulated=True, scale=4.0) as loop,
    RosTopics(loop, port=0) as topics,
):
    print(f"ws://127.0.0.1:{topics.port}")
    loop.show(tool)
    for _ in range(100):
        handle = loop.pose().position
        tool = [x + 0.5 * (h - x) for x, h in zip(tool, handle, strict=True)]
        loop.show(tool)
        topics.update(tool)
        loop.advance(0.02)  # not in real time
print(f"{loop.summary['peak_force']:.2f} N, {loop.summary['verdict']}")
