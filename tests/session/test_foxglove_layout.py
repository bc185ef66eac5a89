"""The layout for Foxglove names topics and fields that sessions have, and shows each of its panels once."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gelflow.session.channels import JSON, PROTOBUF

LAYOUT = json.loads((Path(__file__).resolve().parents[2] / "docs/guide/visualization/foxglove_layout.json").read_text())
PANELS: dict[str, Any] = LAYOUT["configById"]


def paths(config: Any) -> Iterator[str]:
    """All message paths of a panel: a topic, then fields."""
    if isinstance(config, dict):
        for key, value in config.items():
            if isinstance(value, str) and value.startswith("/"):
                yield value
            elif key.startswith("/"):
                yield key
            else:
                yield from paths(value)
    elif isinstance(config, list):
        for entry in config:
            yield from paths(entry)


@pytest.mark.parametrize("panel", list(PANELS))
def test_every_topic_and_field_exists(panel: str) -> None:
    found = list(paths(PANELS[panel]))
    assert found
    for path in found:
        topic, *fields = path.split(".")
        if topic in PROTOBUF:
            descriptor = PROTOBUF[topic].DESCRIPTOR
            for field in fields:
                descriptor = descriptor.fields_by_name[field].message_type
        else:
            assert set(fields) <= set(JSON[topic].properties), path


def test_every_panel_is_shown_once() -> None:
    def shown(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else shown(node["first"]) + shown(node["second"])

    assert sorted(shown(LAYOUT["layout"])) == sorted(PANELS)
