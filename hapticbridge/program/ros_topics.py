"""ROS 2 topics of a device loop, live and without ROS: a WebSocket server for Foxglove's viewers.

The topics and types are those of a recording (``recording.ros_messages``), but for ``/rosout``: a
program hears of no events. The server is that of the package ``foxglove-sdk``.
"""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

import foxglove
import numpy as np
from numpy.typing import ArrayLike

from hapticbridge.errors import HapticBridgeError
from hapticbridge.kernel.record import TICK_DTYPE
from hapticbridge.program.device_loop import DeviceLoop
from hapticbridge.program.poses import numbers_of, pose_of
from hapticbridge.recording.ros_messages import LOG, TOPICS, Messages

WRENCH_ON_TOOL = "/wrench_on_tool"
"""Topic that has messages only if the program says which wrench its tool got."""


class RosTopics:
    """Server of a device loop's topics, at most 60 messages per second each.

    Args:
        loop: Open loop of the device.
        axes: Rotation from the device's frame to the program's, 9 numbers row by row, as the option
            ``axes`` of the loop; by default they are equal.
        host: Address on which the server listens. Every program that reaches it reads all topics.
        port: Its port; 0 takes any free one.

    Attributes:
        port: Port on which it listens.

    Raises:
        HapticBridgeError: The address cannot be used.
    """

    def __init__(
        self,
        loop: DeviceLoop,
        *,
        axes: ArrayLike | None = None,
        host: str = "127.0.0.1",
        port: int = 8765,
    ) -> None:
        self._loop, self._start = loop, time.time_ns()
        turned = np.eye(3) if axes is None else numbers_of("axes", axes).reshape(3, 3)
        self._messages = Messages(self._start, turned)
        self._context = context = foxglove.Context()  # its channels end with it
        self._channels = {
            topic: foxglove.Channel(
                topic,
                message_encoding="cdr",
                schema=foxglove.Schema(name=kind, encoding="ros2msg", data=definition),
                context=context,
            )
            for topic, (kind, definition) in TOPICS.items()
            if topic != LOG
        }
        try:
            self._server = foxglove.start_server(
                name="hapticbridge", host=host, port=port, context=context
            )
        except Exception as error:
            raise HapticBridgeError(f"port {port} of '{host}' cannot be used: {error}") from None
        self.port = int(self._server.port)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def update(self, tool: ArrayLike, wrench: ArrayLike | None = None) -> None:
        """Tells where handle and tool are now, and what the hand feels; call it in each step.

        Args:
            tool: Pose of the tool, as for ``DeviceLoop.show``.
            wrench: Wrench on the tool in the world frame, as ``DeviceLoop.wrench`` returned it.
        """
        handle, row = self._loop.pose(), np.zeros(1, TICK_DTYPE)
        row["deadline_ns"] = time.time_ns() - self._start
        row["handle_position"], row["handle_quaternion"] = handle.position, handle.quaternion
        pose = pose_of(tool, handle.quaternion)
        row["tool_position"], row["tool_quaternion"] = pose[:3], pose[3:]
        row["wrench_on_device"] = handle.wrench
        if wrench is not None:
            row["wrench_on_tool"] = numbers_of("wrench", wrench)
        for topic, messages in self._messages.of_ticks(row).items():
            if topic != WRENCH_ON_TOOL or wrench is not None:
                for message in messages:
                    payload, log_time = message["payload"].tobytes(), int(message["time"])
                    self._channels[topic].log(payload, log_time=log_time)

    def close(self) -> None:
        """Ends the server."""
        self._server.stop()
