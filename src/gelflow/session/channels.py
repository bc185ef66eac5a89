"""Topic, schema and encoding of each channel of a session file.

Images, poses and joints use Foxglove's published protobuf schemas, so that Foxglove and Rerun display them; all other
channels are JSON with a JSON schema.
"""

import json
from dataclasses import dataclass, field
from typing import Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from gelflow.session.records import SENSORS

NUMBER = {"type": ["number", "string"]}  # a string only for "NaN", "Infinity" and "-Infinity"
NUMBER_OR_NULL = {"type": ["number", "string", "null"]}
INTEGER = {"type": "integer"}
TEXT = {"type": "string"}
FLAG = {"type": "boolean"}
NUMBERS = {"type": "array", "items": NUMBER}
INTEGERS = {"type": "array", "items": INTEGER}
PAIRS = {"type": "array", "items": NUMBERS}
FLAGS = {"type": "array", "items": FLAG}
TABLE = {"type": "object"}

BASE_FRAME = "base"
TOOL_FRAME = "tool"


@dataclass(frozen=True)
class JsonChannel:
    """A channel of JSON objects; `required` names the properties that every object has."""

    name: str
    properties: dict[str, Any] = field(default_factory=dict)
    required: tuple[str, ...] = ()

    def schema(self) -> bytes:
        """The JSON schema of the objects, as UTF-8."""
        document = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": self.name,
            "type": "object",
            "properties": self.properties,
            "required": list(self.required),
        }
        return json.dumps(document).encode()


PROTOBUF: dict[str, Any] = {
    **{f"/{sensor}/image": CompressedImage for sensor in SENSORS},
    **{f"/{sensor}/annotations": ImageAnnotations for sensor in SENSORS},
    "/arm/pose": PoseInFrame,
    "/arm/joints": JointStates,
    "/arm/command": PoseInFrame,
    "/arm/applied": PoseInFrame,
    "/tf": FrameTransform,
    "/flow_map": RawImage,
    "/log": Log,
}

JSON: dict[str, JsonChannel] = {
    "/session": JsonChannel(
        "gelflow.Session", {"format": INTEGER, "epoch": NUMBER, "task": TABLE, "versions": TABLE}, ("format",)
    ),
    **{
        f"/{sensor}/markers": JsonChannel(
            "gelflow.Markers",
            {
                "stamp": NUMBER,
                "rows": INTEGER,
                "cols": INTEGER,
                "spacing_px": NUMBER,
                "position_px": PAIRS,
                "displacement_px": PAIRS,
                "displacement_mm": PAIRS,
                "valid": FLAGS,
                "inferred": FLAGS,
                "quality": NUMBERS,
            },
            ("stamp", "rows", "cols", "spacing_px", "position_px", "displacement_px", "valid", "inferred", "quality"),
        )
        for sensor in SENSORS
    },
    **{
        f"/{sensor}/force": JsonChannel(
            "gelflow.Force",
            {
                "stamp": NUMBER,
                "contact": FLAG,
                "shear": NUMBERS,
                "shear_deviation": NUMBERS,
                "normal": NUMBER,
                "normal_deviation": NUMBER,
                "moment": NUMBER,
                "moment_deviation": NUMBER,
                "centre_mm": {"type": ["array", "null"], "items": NUMBER},
                "contact_area_mm2": NUMBER,
                "unexplained": NUMBER,
                "stick_share": NUMBER_OR_NULL,
                "stick_share_deviation": NUMBER_OR_NULL,
                "gross_slip": FLAG,
                "gross_slip_since": NUMBER_OR_NULL,
                "gross_slip_confidence": NUMBER_OR_NULL,
                "friction": NUMBER_OR_NULL,
                "friction_observed": FLAG,
            },
            ("stamp", "contact", "shear", "shear_deviation", "normal", "normal_deviation"),
        )
        for sensor in SENSORS
    },
    **{
        f"/{sensor}/timing": JsonChannel(
            "gelflow.ImageTiming",
            {"stamp": NUMBER, "sequence": INTEGER, "camera_time": NUMBER},
            ("stamp", "sequence", "camera_time"),
        )
        for sensor in SENSORS
    },
    "/arm/status": JsonChannel(
        "gelflow.ArmStatus",
        {"stamp": NUMBER, "motors_on": FLAG, "running": FLAG, "operating_mode": TEXT, "fault": TEXT},
        ("stamp", "motors_on", "running", "operating_mode", "fault"),
    ),
    "/gripper/state": JsonChannel(
        "gelflow.GripperState",
        {
            "width": NUMBER,
            "speed": NUMBER,
            "force": NUMBER,
            "referenced": FLAG,
            "grasp": TEXT,
            "fault": TEXT,
            "stamp": NUMBER,
        },
        ("width", "speed", "force", "referenced", "grasp", "fault", "stamp"),
    ),
    "/gripper/command": JsonChannel(
        "gelflow.GripperCommand", {"stamp": NUMBER, "name": TEXT, "values": TABLE}, ("stamp", "name", "values")
    ),
    "/attempt": JsonChannel("gelflow.Attempt", {"insertion": INTEGER, "attempt": INTEGER}),
    "/decision": JsonChannel(
        "gelflow.Decision",
        {
            "insertion": INTEGER,
            "attempt": INTEGER,
            "tracked": {"type": "array", "items": INTEGERS},
            "reference": INTEGERS,
            "frames": {"type": "array", "items": INTEGERS},
            "flow": NUMBERS,
            "flow_shape": INTEGERS,
            "divisor": NUMBER,
            "unit": TEXT,
            "action": NUMBERS,
            "correction": NUMBERS,
            "depths": NUMBERS,
            "stamp": NUMBER,
        },
        ("insertion", "attempt", "tracked", "reference", "frames", "flow", "flow_shape", "divisor", "unit", "action"),
    ),
    "/checks": JsonChannel(
        "gelflow.Checks", {"stamp": NUMBER, "checks": {"type": "array", "items": TABLE}}, ("stamp", "checks")
    ),
    "/event": JsonChannel("gelflow.Event", {"stamp": NUMBER, "name": TEXT, "values": TABLE}, ("name", "values")),
}


def register_channels(writer: Writer) -> dict[str, int]:
    """Register all schemas and channels of a session; returns the channel number of each topic."""
    channels = {}
    schemas: dict[str, int] = {}
    for topic, kind in PROTOBUF.items():
        name = kind.DESCRIPTOR.full_name
        if name not in schemas:
            description = build_file_descriptor_set(kind).SerializeToString()
            schemas[name] = writer.register_schema(name, "protobuf", description)
        channels[topic] = writer.register_channel(topic, "protobuf", schemas[name])
    for topic, channel in JSON.items():
        schema = writer.register_schema(channel.name, "jsonschema", channel.schema())
        channels[topic] = writer.register_channel(topic, "json", schema)
    return channels
