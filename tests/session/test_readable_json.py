"""JSON for files that people open."""

import json
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from gelflow.session.records import readable_json, to_plain


@given(
    st.recursive(
        st.none() | st.integers() | st.floats() | st.text("[1, ]\n"),
        lambda v: st.lists(v) | st.dictionaries(st.text(), v),
    )
)
def test_readable_json_keeps_every_value(value: Any) -> None:
    assert repr(json.loads(readable_json(value))) == repr(to_plain(value))


def test_readable_json_has_lists_of_numbers_on_one_line() -> None:
    assert (
        readable_json({"a": [1.5, -2e-05, 3], "b": ["x"]}) == '{\n  "a": [1.5, -2e-05, 3],\n  "b": [\n    "x"\n  ]\n}\n'
    )
