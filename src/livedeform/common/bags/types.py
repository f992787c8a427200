"""Message types without ROS: their definitions, and messages decoded from and encoded to CDR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from livedeform.common.errors import RecordingError

__all__ = ["RawMessage", "TypeDefinition", "decode", "encode", "message_class"]


@dataclass(frozen=True)
class TypeDefinition:
    """A message type's text: ``encoding`` ros2msg or ros2idl, empty where the bag holds none."""

    encoding: str
    text: str


@dataclass(frozen=True)
class RawMessage:
    """One serialised message (CDR)."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    definition: TypeDefinition = field(default=TypeDefinition("", ""), repr=False)


def decode(raw: RawMessage) -> Any:
    """Decode a message to an object with the fields of its type; ``RecordingError`` if its bytes do not fit."""
    store = typestore(raw.type, raw.definition)
    try:
        return store.deserialize_cdr(raw.data, raw.type)
    except Exception as error:  # truncated or foreign bytes fail in many ways inside the generated decoder
        raise RecordingError(
            f"a message at {raw.log_time_ns} ns cannot be decoded as {raw.type} ({error})",
            where=raw.topic,
            remedy="the message is damaged; 'livedeform info' counts such messages",
        ) from error


def encode(message: Any) -> bytes:
    """Encode a message made with ``message_class`` to CDR."""
    return bytes(jazzy().serialize_cdr(message, message.__msgtype__))


def message_class(type_name: str) -> Callable[..., Any]:
    """Return the rosbags class of a Jazzy message type, to fill and ``encode`` without ROS."""
    return jazzy().types[type_name]


@lru_cache(maxsize=1)
def jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=256)
def typestore(type_name: str, definition: TypeDefinition) -> Typestore:
    """Return the types that one schema defines, or Jazzy's where there is no schema; ``RecordingError`` if neither
    serves."""
    remedy = "the topic is skipped; the rest of the bag is used"
    if not definition.text.strip():
        if type_name not in jazzy().fielddefs:
            raise RecordingError(f"type '{type_name}' is unknown and the bag holds no schema for it", remedy=remedy)
        return jazzy()
    parsers: dict[str, Callable[[str, str], Any]] = {
        "ros2msg": get_types_from_msg,
        "ros2idl": lambda text, _: get_types_from_idl(text),
    }
    parse = parsers.get(definition.encoding)
    if parse is None:
        raise RecordingError(f"schema encoding '{definition.encoding}' is not a ROS 2 one", remedy=remedy)
    try:
        store = get_typestore(Stores.EMPTY)
        store.register(parse(definition.text, type_name))
        store.get_msgdef(type_name)
    except Exception as error:  # the parsers raise many kinds on schemas that are not quite ROS's
        raise RecordingError(
            f"the schema of type '{type_name}' cannot be parsed ({one_line(error)})", remedy=remedy
        ) from error
    return store


def jazzy_definition(type_name: str) -> TypeDefinition:
    if type_name not in jazzy().fielddefs:
        raise RecordingError(f"message type '{type_name}' is unknown", remedy="pass its definition to BagWriter.write")
    text, _ = jazzy().generate_msgdef(type_name, ros_version=2)
    return TypeDefinition("ros2msg", text)


def type_hash(type_name: str, definition: TypeDefinition) -> str:
    try:
        return typestore(type_name, definition).hash_rihs01(type_name)
    except (RecordingError, KeyError):
        return ""


def one_line(error: Exception) -> str:
    """Return what a library says in one short line."""
    return " ".join(str(error).split())[:100] or type(error).__name__
