"""JSON objects with a digest: no change of a bit gives another value."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.records import digested_json
from services.records.json_values import JsonValue

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.text(max_size=12),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
OBJECTS = st.dictionaries(st.text(max_size=8).filter(lambda name: name != digested_json.DIGEST), VALUES, max_size=5)


@given(OBJECTS, st.integers(0, 2**20), st.integers(0, 7))
def test_a_flipped_bit_is_an_error_or_changes_nothing(entries: dict[str, JsonValue], place: int, bit: int) -> None:
    content = bytearray(digested_json.encoded(entries))
    assert digested_json.decoded(bytes(content)) == entries
    content[place % len(content)] ^= 1 << bit
    try:
        found = digested_json.decoded(bytes(content))
    except ValueError:
        return
    assert found == entries  # a bit of the white space, or of the escape of a character


@pytest.mark.parametrize("content", [b'{"salt": "00", "hash": "11"}', b"[]", b"{"])
def test_an_object_without_its_digest_is_an_error(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"SHA-256|object|Expecting"):
        digested_json.decoded(content)
