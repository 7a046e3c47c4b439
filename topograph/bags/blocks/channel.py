"""What the readers of blocks have in common."""

from __future__ import annotations

from dataclasses import dataclass

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

Entry = tuple[int, int, bytes]
"""Channel, time of recording (ns), message."""


def msgtype_of(name: str) -> str:
    """A type's name in ROS 2's way: sensor_msgs/Imu is sensor_msgs/msg/Imu."""
    package, _, typ = name.partition("/")
    return name if "/msg/" in name else f"{package}/msg/{typ}"


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic of a recording, its type (ROS 2's way of writing it) and the type's definition ("" where the file has none)."""

    topic: str
    msgtype: str
    definition: str = ""
    idl: bool = False

    @property
    def msgdef(self) -> MessageDefinition:
        form = MessageDefinitionFormat.IDL if self.idl else MessageDefinitionFormat.MSG
        return MessageDefinition(form if self.definition else MessageDefinitionFormat.NONE, self.definition)
